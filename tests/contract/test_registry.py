"""Digests come from registries by their own protocol: Debian's docker-registry on loopback, open and with a password."""

import base64
import contextlib
import hashlib
import http.server
import json
import shutil
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.client import HTTPMessage
from pathlib import Path

import pytest

from fogspec.backends.images.registry import Registry, _NoCredentialsElsewhere
from fogspec.base.errors import CloudError, InvalidInput
from tests.support.registries import HTPASSWD, PASSWORD, USER
from tests.support.running import CATALOG, Shell, shell, spec  # noqa: F401

MANIFEST = "application/vnd.oci.image.manifest.v1+json"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def serve(folder: Path, auth: str) -> Iterator[str]:
    if not shutil.which("docker-registry"):
        pytest.skip("needs docker-registry: apt-get install docker-registry")
    port = free_port()
    folder.mkdir(parents=True)
    (folder / "config.yml").write_text(
        f"version: 0.1\nlog: {{level: error}}\nstorage: {{filesystem: {{rootdirectory: {folder}/images}}}}\n"
        f"http: {{addr: '127.0.0.1:{port}'}}\n{auth}"
    )
    with open(folder / "log", "wb") as log:
        process = subprocess.Popen(["docker-registry", "serve", str(folder / "config.yml")], stdout=log, stderr=log)
    try:
        for _ in range(200):
            with socket.socket() as one:
                if one.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.05)
        yield f"127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(10)


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    yield from serve(tmp_path_factory.mktemp("open") / "registry", "")


@pytest.fixture(scope="module")
def private(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("private")
    (folder / "htpasswd").write_text(HTPASSWD)
    yield from serve(folder / "registry", f"auth: {{htpasswd: {{realm: here, path: {folder}/htpasswd}}}}\n")


def send(method: str, url: str, body: bytes = b"", kind: str = "application/octet-stream", user: bool = False) -> str:
    request = urllib.request.Request(url, data=body, method=method, headers={"Content-Type": kind})
    if user:
        request.add_header("Authorization", "Basic " + base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode())
    with urllib.request.urlopen(request, timeout=120) as answer:
        return str(answer.headers.get("Location", ""))


def push(registry: str, name: str, tag: str, layer: bytes, user: bool = False) -> str:
    """Push an image of one layer; returns its digest."""
    described = []
    for blob, kind in ((b"{}", "config.v1+json"), (layer, "layer.v1.tar")):
        digest = f"sha256:{hashlib.sha256(blob).hexdigest()}"
        where = send("POST", f"http://{registry}/v2/{name}/blobs/uploads/", user=user)
        send("PUT", f"{where}&digest={digest}", blob, user=user)
        described.append({"mediaType": f"application/vnd.oci.image.{kind}", "digest": digest, "size": len(blob)})
    manifest = json.dumps(
        {"schemaVersion": 2, "mediaType": MANIFEST, "config": described[0], "layers": described[1:]}
    ).encode()
    send("PUT", f"http://{registry}/v2/{name}/manifests/{tag}", manifest, MANIFEST, user=user)
    return f"sha256:{hashlib.sha256(manifest).hexdigest()}"


def project(shell: Shell, image: str) -> None:
    shell.write("offers.csv", CATALOG)
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec(ros=f"{{distro: jazzy, image: '{image}'}}"))


def test_a_tag_is_locked_compiled_moved_and_upgraded(registry: str, shell: Shell) -> None:
    image = f"{registry}/robots/planner:v1"
    first = push(registry, "robots/planner", "v1", b"first")
    project(shell, image)
    unlocked = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv")
    assert f"image {image} is not pinned" in shell.read("compiled/demo/plan.yaml") + unlocked.out
    shell("lock", "--check", code=3)
    assert not (shell.folder / "fogspec.lock").exists()
    shell("lock", "--catalog", "offers.csv")
    assert first in shell.read("fogspec.lock")
    shell("lock", "--check")
    shell("compile", "specs/demo.yaml")
    task = shell.read("compiled/demo/tasks/aws-r1-a-small.sky.yaml")
    assert f'image_id: "docker:{registry}/robots/planner@{first}"' in task
    assert "not pinned" not in shell.read("compiled/demo/plan.yaml")

    second = push(registry, "robots/planner", "v1", b"second")
    before = shell.read("fogspec.lock")
    shell("lock")
    assert shell.read("fogspec.lock") == before, "what is locked stays"
    assert "plan" in shell("lock", "--upgrade", "plan", code=2).err
    said = shell("lock", "--upgrade", image).out
    assert f"{first} -> {second}" in said
    shell("compile", "specs/demo.yaml", "--check", code=3)


def test_what_a_registry_does_not_have_is_said(registry: str, shell: Shell) -> None:
    project(shell, f"{registry}/robots/nobody:v1")
    assert "has no such image" in shell("lock", code=1).err
    assert not (shell.folder / "fogspec.lock").exists()


def test_a_registry_that_is_not_there_is_the_networks_fault(shell: Shell) -> None:
    project(shell, f"127.0.0.1:{free_port()}/robots/planner:v1")
    said = shell("lock", code=6).err
    assert "cannot be asked" in said
    assert "HTTPS_PROXY" in said
    assert "IMAGE@sha256:" in said
    project(shell, f"127.0.0.1:{free_port()}/robots/planner@sha256:{'0' * 64}")
    shell("lock", "--catalog", "offers.csv")


def test_a_private_registry_is_read_with_what_docker_keeps_and_nothing_of_it_is_written(
    private: str, shell: Shell
) -> None:
    digest = push(private, "robots/secret", "v1", b"secret", user=True)
    project(shell, f"{private}/robots/secret:v1")
    assert "docker login" in shell("lock", code=1).err
    packed = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
    shell.write("../docker/config.json", json.dumps({"auths": {private: {"auth": packed}}}))
    said = shell("lock")
    assert digest in shell.read("fogspec.lock")
    for text in (said.out, said.err, *(path.read_text() for path in shell.folder.rglob("*") if path.is_file())):
        assert PASSWORD not in text
        assert packed not in text


def test_a_credential_helper_is_asked(private: str, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    digest = push(private, "robots/helped", "v1", b"helped", user=True)
    helper = shell.write("../bin/docker-credential-test", "#!/bin/sh\nread key\n"
                         f'[ "$key" = "{private}" ] && printf \'{{"Username":"{USER}","Secret":"{PASSWORD}"}}\'\n')  # fmt: skip
    helper.chmod(0o755)
    monkeypatch.setenv("PATH", str(helper.parent), prepend=":")
    shell.write("../docker/config.json", json.dumps({"credHelpers": {private: "test"}}))
    assert Registry().digest(f"{private}/robots/helped:v1") == digest


def test_a_damaged_docker_configuration_is_named(private: str, shell: Shell) -> None:
    shell.write("../docker/config.json", "{")
    with pytest.raises(InvalidInput, match=r"config\.json"):
        Registry().digest(f"{private}/robots/planner:v1")


class Tokens(http.server.BaseHTTPRequestHandler):
    """A registry behind a token server, as Docker Hub and GitHub's are; `lies` makes it send another digest."""

    lies = False

    def do_GET(self) -> None:
        if self.path.startswith("/token"):
            good = "scope=repository%3Aa%2Fb%3Apull" in self.path and "service=here" in self.path
            return self._answer(200 if good else 400, json.dumps({"token": "abc"}).encode())
        if self.headers.get("Authorization") != "Bearer abc":
            port = self.server.server_address[1]
            realm = f'Bearer realm="http://127.0.0.1:{port}/token",service="here",scope="repository:a/b:pull"'
            return self._answer(401, b"", {"WWW-Authenticate": realm})
        digest = "sha256:" + ("0" * 64 if self.lies else hashlib.sha256(b"{}").hexdigest())
        return self._answer(200, b"{}", {"Docker-Content-Digest": digest})

    def _answer(self, code: int, body: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(code)
        for key, value in (headers or {}).items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.mark.parametrize("lies", [False, True])
def test_a_token_server_is_asked_first_and_a_digest_is_checked(lies: bool, shell: Shell) -> None:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (Tokens,), {"lies": lies}))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        name = f"127.0.0.1:{server.server_address[1]}/a/b:v1"
        if lies:
            with pytest.raises(CloudError, match="says sha256:0000"):
                Registry().digest(name)
        else:
            assert Registry().digest(name) == f"sha256:{hashlib.sha256(b'{}').hexdigest()}"
    finally:
        server.shutdown()
        server.server_close()


def answering(handler: type[http.server.BaseHTTPRequestHandler]) -> Iterator[str]:
    """Serve on loopback; yield host and port."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


class Elsewhere(http.server.BaseHTTPRequestHandler):
    """Another server, which keeps the headers that it is sent."""

    seen: list[dict[str, str]]

    def do_GET(self) -> None:
        self.seen.append(dict(self.headers))
        self.send_response(200)
        self.send_header("Content-Length", "2")
        self.end_headers()
        self.wfile.write(b"{}")

    def log_message(self, *_: object) -> None:
        pass


class Redirecting(Elsewhere):
    """A registry with a password that sends everybody who knows it to `target`."""

    target: str

    def do_GET(self) -> None:
        self.seen.append(dict(self.headers))
        known = self.headers.get("Authorization", "")
        self.send_response(307 if known else 401)
        self.send_header("Location" if known else "WWW-Authenticate", self.target if known else 'Basic realm="here"')
        self.send_header("Content-Length", "0")
        self.end_headers()


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("{here}", None),
        ("http://registry.invalid/v2", "not https"),
        ("ftp://{elsewhere}/v2", "not https"),
        ("file:///etc/passwd", "refuses"),
    ],
)
def test_credentials_follow_no_redirection(target: str, words: str | None, shell: Shell) -> None:
    other = type("Other", (Elsewhere,), {"seen": []})
    for elsewhere in answering(other):
        where = target.format(here=f"http://{elsewhere}/v2", elsewhere=elsewhere)
        for registry in answering(type("First", (Redirecting,), {"seen": [], "target": where})):
            packed = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
            shell.write("../docker/config.json", json.dumps({"auths": {registry: {"auth": packed}}}))
            if words is None:
                assert Registry().digest(f"{registry}/a/b:v1") == f"sha256:{hashlib.sha256(b'{}').hexdigest()}"
            else:
                with pytest.raises(CloudError, match=words):
                    Registry().digest(f"{registry}/a/b:v1")
    assert not any("Authorization" in headers for headers in other.seen)


def test_a_downgrade_to_http_is_refused_before_anything_is_sent() -> None:
    asked = urllib.request.Request("https://registry.invalid/v2", headers={"Authorization": "Basic abc"})
    with pytest.raises(ValueError, match="not https"):
        _NoCredentialsElsewhere().redirect_request(asked, None, 307, "", HTTPMessage(), "http://registry.invalid/v2")
    asked = urllib.request.Request("https://registry.invalid/v2", headers={"Authorization": "Basic abc"})
    for other in ("https://registry.invalid:444/v2", "https://other.invalid/v2"):
        again = _NoCredentialsElsewhere().redirect_request(asked, None, 307, "", HTTPMessage(), other)
        assert again is not None
        assert not again.has_header("Authorization")
    same = _NoCredentialsElsewhere().redirect_request(
        asked, None, 307, "", HTTPMessage(), "https://registry.invalid/v3"
    )
    assert same is not None
    assert same.has_header("Authorization")


def test_a_refresh_token_is_not_sent_on() -> None:
    asked = urllib.request.Request("https://token.invalid", data=b"refresh_token=abc")
    with pytest.raises(ValueError, match="redirects what holds a secret"):
        _NoCredentialsElsewhere().redirect_request(asked, None, 302, "", HTTPMessage(), "https://token.invalid/2")


class Dripping(Elsewhere):
    """Never stops answering, and never says anything."""

    ended: threading.Event

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "1000000")
        self.end_headers()
        while not self.ended.wait(0.02):
            self.wfile.write(b"x")


def test_a_registry_that_answers_a_byte_at_a_time(monkeypatch: pytest.MonkeyPatch, shell: Shell) -> None:
    monkeypatch.setattr("fogspec.backends.images.registry.DEADLINE_S", 0.5)
    ended = threading.Event()
    try:
        for registry in answering(type("Drips", (Dripping,), {"seen": [], "ended": ended})):
            project(shell, f"{registry}/a/b:v1")
            said = shell("lock", code=6).err
            assert "it took longer than 0.5 s to answer" in said
            ended.set()
    finally:
        ended.set()


class Endless(Elsewhere):
    """Sends more than a manifest may have."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        with contextlib.suppress(OSError):
            for _ in range(64):
                self.wfile.write(bytes(1 << 20))


def test_a_registry_that_sends_too_much() -> None:
    for registry in answering(type("Endless", (Endless,), {"seen": []})):
        with pytest.raises(CloudError, match="longer than a manifest may be"):
            Registry().digest(f"{registry}/a/b:v1")
