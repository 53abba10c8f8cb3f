"""Where registry credentials go, seen from the other end of real connections: two servers on loopback that write down all."""

import base64
import hashlib
import http.server
import json
import os
import stat
import threading
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from http.client import HTTPMessage
from pathlib import Path
from typing import Any

import pytest

from fogspec.backends.images.credentials import credentials
from fogspec.backends.images.registry import Registry, _NoCredentialsElsewhere
from fogspec.base.errors import CloudError, FogspecError, InvalidInput
from fogspec.language.lockfile import ImageUse

BODY = b'{"schemaVersion": 2}'
DIGEST = f"sha256:{hashlib.sha256(BODY).hexdigest()}"
BASIC = f"Basic {base64.b64encode(b'reader:hunter2').decode()}"
Answer = tuple[int, dict[str, str], bytes]


@dataclass
class Server:
    """An HTTP server on loopback that answers by a function, and keeps every request.

    With `drips` set it sends one byte at a time of an answer without end, until the event is set.
    """

    answer: Callable[[Any], Answer] = lambda _request: (200, {}, BODY)
    seen: list[tuple[str, str, str | None, bytes]] = field(default_factory=list)
    accepted: list[str] = field(default_factory=list)
    address: str = ""
    drips: threading.Event | None = None

    @property
    def given(self) -> list[str]:
        """The credentials that it was given."""
        return [given for *_, given, _ in self.seen if given is not None]


@pytest.fixture
def servers() -> Iterator[Callable[[], Server]]:
    running = []

    def start() -> Server:
        server = Server()

        class Handler(http.server.BaseHTTPRequestHandler):
            def do(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                server.seen.append((self.command, self.path, self.headers.get("Authorization"), body))
                server.accepted.append(self.headers.get("Accept", ""))
                code, headers, content = server.answer(self)
                self.send_response(code)
                for name, value in {"Content-Length": str(len(content)), **headers}.items():
                    self.send_header(name, value)
                self.end_headers()
                while server.drips is not None and not server.drips.wait(0.02):
                    self.wfile.write(b"x")
                self.wfile.write(content)

            do_GET = do_POST = do

            def log_message(self, *_: object) -> None:
                pass

        listening = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=listening.serve_forever, args=(0.01,), daemon=True).start()
        running.append(listening)
        server.address = f"127.0.0.1:{listening.server_port}"
        return server

    yield start
    for one in running:
        one.shutdown()
        one.server_close()


@pytest.fixture
def docker(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[dict[str, Any]], None]:
    """Write docker's configuration."""
    monkeypatch.setenv("DOCKER_CONFIG", str(tmp_path))
    return lambda config: (tmp_path / "config.json").write_text(json.dumps(config)) and None


def login(address: str) -> dict[str, Any]:
    return {"auths": {address: {"auth": base64.b64encode(b"reader:hunter2").decode()}}}


def asked_first(then: Callable[[Any], Answer], challenge: str = "Basic realm=x") -> Callable[[Any], Answer]:
    """Answer without credentials with a challenge, with them as `then` does."""
    return lambda request: (
        then(request) if request.headers.get("Authorization") else (401, {"WWW-Authenticate": challenge}, b"")
    )


def test_credentials_are_sent_only_when_they_are_asked_for(servers: Any, docker: Any) -> None:
    one = servers()
    docker(login(one.address))
    assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
    assert one.given == []
    one.answer = asked_first(lambda _: (200, {"Docker-Content-Digest": DIGEST}, BODY))
    assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
    assert one.given == [BASIC]
    assert [path for _, path, *_ in one.seen] == ["/v2/robot/manifests/v1"] * 3
    assert len(set(one.accepted)) == 1, "with credentials the request accepts the same types"


def test_images_and_lists_of_images_for_several_processors_are_asked_for(servers: Any) -> None:
    one = servers()
    Registry().digest(f"{one.address}/robot:v1")
    kinds = ("oci.image.{}.v1+json", "docker.distribution.manifest.{}v2+json")
    wanted = {f"application/vnd.{kinds[0].format(what)}" for what in ("index", "manifest")}
    wanted |= {f"application/vnd.{kinds[1].format(what)}" for what in ("list.", "")}
    assert {word.strip() for word in one.accepted[0].split(",")} == wanted


@pytest.mark.parametrize("code", [301, 302, 303, 307, 308])
def test_no_redirect_takes_credentials_to_another_host(servers: Any, docker: Any, code: int) -> None:
    one, other = servers(), servers()
    docker(login(one.address))
    one.answer = asked_first(lambda _: (code, {"Location": f"http://{other.address}/elsewhere"}, b""))
    try:
        assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
    except FogspecError:
        assert other.seen == [], "refused altogether"
    assert one.given == [BASIC]
    assert other.given == []


@pytest.mark.parametrize(
    ("location", "said"),
    [
        ("file:///etc/passwd", "refuses"),
        ("ftp://127.0.0.1/x", "not https"),
        ("http://registry.invalid/v2", "not https"),
        ("gopher://x/", "refuses"),
        ("//", None),
    ],
)
def test_a_redirect_leads_to_no_other_kind_of_place(servers: Any, docker: Any, location: str, said: str | None) -> None:
    one = servers()
    docker(login(one.address))
    for answer in (
        lambda _: (302, {"Location": location}, b""),
        asked_first(lambda _: (307, {"Location": location}, b"")),
    ):
        one.answer = answer
        with pytest.raises(FogspecError, match=said):
            Registry().digest(f"{one.address}/robot:v1")


def test_credentials_stay_with_scheme_host_and_port() -> None:
    def redirected(other: str) -> urllib.request.Request | None:
        asked = urllib.request.Request("https://registry.invalid/v2", headers={"Authorization": "Basic abc"})
        return _NoCredentialsElsewhere().redirect_request(asked, None, 307, "", HTTPMessage(), other)

    with pytest.raises(ValueError, match="not https"):
        redirected("http://registry.invalid/v2")
    for other, kept in (
        ("//registry.invalid:444/v2", False),
        ("//other.invalid/v2", False),
        ("//registry.invalid/3", True),
    ):
        again = redirected(f"https:{other}")
        assert again is not None
        assert again.has_header("Authorization") == kept


@pytest.mark.parametrize(
    "realm", ["http://registry.example/token", "ftp://127.0.0.1/token", "", "http://127.0.0.1.example/t"]
)
def test_no_token_server_without_https_is_asked(servers: Any, docker: Any, realm: str) -> None:
    one = servers()
    docker(login(one.address))
    one.answer = lambda _: (401, {"WWW-Authenticate": f'Bearer realm="{realm}",service="s"'}, b"")
    with pytest.raises(FogspecError, match="not https"):
        Registry().digest(f"{one.address}/robot:v1")
    assert one.given == []


def test_a_token_server_on_loopback_is_asked_with_the_name_and_the_registry_with_its_token(
    servers: Any, docker: Any
) -> None:
    one, tokens = servers(), servers()
    docker(login(one.address))
    challenge = f'Bearer realm="http://{tokens.address}/token",service="the service",scope="more:than:that"'
    one.answer = asked_first(lambda _: (200, {}, BODY), challenge)
    tokens.answer = lambda _: (200, {}, b'{"token": "t-1"}')
    assert Registry().digest(f"{one.address}/team/robot:v1") == DIGEST
    ((method, path, given, _),) = tokens.seen
    assert (method, given) == ("GET", BASIC)
    assert path == "/token?service=the+service&scope=repository%3Ateam%2Frobot%3Apull", "its own repository, to read"
    assert one.given == ["Bearer t-1"]


def test_an_identity_token_is_exchanged_by_a_form(servers: Any, docker: Any) -> None:
    one, tokens = servers(), servers()
    docker({"auths": {one.address: {"identitytoken": "hunter2"}}})
    one.answer = asked_first(lambda _: (200, {}, BODY), f'Bearer realm="http://{tokens.address}/token",service="s"')
    tokens.answer = lambda _: (200, {}, b'{"access_token": "t-2"}')
    assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
    ((method, path, given, form),) = tokens.seen
    assert (method, path, given) == ("POST", "/token", None)
    assert b"refresh_token=hunter2" in form
    assert b"grant_type=refresh_token" in form
    assert one.given == ["Bearer t-2"]


@pytest.mark.parametrize("code", [301, 302, 303, 307, 308])
def test_no_redirect_takes_an_identity_token_elsewhere(servers: Any, docker: Any, code: int) -> None:
    one, tokens, other = servers(), servers(), servers()
    docker({"auths": {one.address: {"identitytoken": "hunter2"}}})
    one.answer = asked_first(lambda _: (200, {}, BODY), f'Bearer realm="http://{tokens.address}/token"')
    tokens.answer = lambda _: (code, {"Location": f"http://{other.address}/token"}, b"")
    with pytest.raises(FogspecError, match="redirects what holds a secret"):
        Registry().digest(f"{one.address}/robot:v1")
    assert not [body for *_, body in other.seen if b"hunter2" in body]


@pytest.mark.parametrize(
    ("answer", "error", "said"),
    [
        ((404, {}, b""), InvalidInput, "has no such image"),
        ((403, {}, b""), InvalidInput, "does not show it"),
        ((401, {}, b""), InvalidInput, "does not show it"),
        ((429, {}, b""), CloudError, "too many requests"),
        ((500, {}, b""), CloudError, "HTTP 500"),
        ((200, {"Docker-Content-Digest": f"sha256:{'0' * 64}"}, BODY), CloudError, "and what it sent has"),
        ((200, {"Docker-Content-Digest": "md5:1"}, BODY), CloudError, "and what it sent has"),
    ],
)
def test_what_a_registry_refuses_is_said(
    servers: Any, docker: Any, answer: Answer, error: type[FogspecError], said: str
) -> None:
    one = servers()
    docker({})
    one.answer = lambda _: answer
    with pytest.raises(error, match=said):
        Registry().digest(f"{one.address}/robot:v1")


def test_an_answer_longer_than_a_manifest_is_cut_off(servers: Any, docker: Any) -> None:
    one = servers()
    docker({})
    one.answer = lambda _: (200, {}, b" " * (4 << 20))
    assert Registry().digest(f"{one.address}/robot:v1").startswith("sha256:")
    one.answer = lambda _: (200, {}, b" " * ((4 << 20) + 1))
    with pytest.raises(CloudError, match="longer than a manifest may be"):
        Registry().digest(f"{one.address}/robot:v1")


def test_an_answer_of_a_byte_at_a_time_ends(servers: Any, docker: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fogspec.backends.images.registry.DEADLINE_S", 0.5)
    one = servers()
    docker({})
    one.drips = threading.Event()
    one.answer = lambda _: (200, {"Content-Length": "1000000"}, b"")
    try:
        with pytest.raises(CloudError, match=r"it took longer than 0\.5 s to answer"):
            Registry().digest(f"{one.address}/robot:v1")
    finally:
        one.drips.set()


def test_a_name_that_is_none_is_asked_nowhere(docker: Any) -> None:
    docker({})
    with pytest.raises(InvalidInput):
        Registry().digest("127.0.0.1:1/NOT A NAME")


def test_a_registry_that_is_not_there_is_said_in_the_systems_words(docker: Any) -> None:
    docker({})
    with pytest.raises(CloudError, match=r"127\.0\.0\.1:1 cannot be asked: \[Errno \d+\] Connection refused$"):
        Registry().digest("127.0.0.1:1/robot:v1")


# What machines are for, and their login


def of_config(cpu: str) -> Callable[[Any], Answer]:
    """Answer with an image whose configuration says its CPU."""
    config = json.dumps({"os": "linux", "architecture": cpu}).encode()
    digest = f"sha256:{hashlib.sha256(config).hexdigest()}"
    manifest = json.dumps({"schemaVersion": 2, "config": {"digest": digest}}).encode()
    return lambda request: (200, {}, config if request.path == f"/v2/robot/blobs/{digest}" else manifest)


def of_index(*platforms: tuple[str, str]) -> Callable[[Any], Answer]:
    """Answer with an index of images for these systems and CPUs."""
    listed = [{"platform": {"os": system, "architecture": cpu}} for system, cpu in platforms]
    return lambda _: (200, {}, json.dumps({"schemaVersion": 2, "manifests": listed}).encode())


@pytest.mark.parametrize(
    ("answer", "wanted", "said"),
    [
        (of_config("amd64"), ["x86_64"], None),
        (of_config("amd64"), ["x86_64", "arm64"], "is for amd64, and spec.hardware.arch has arm64"),
        (of_index(("linux", "amd64"), ("linux", "arm64")), ["x86_64", "arm64"], None),
        (
            of_index(("linux", "arm64"), ("windows", "amd64")),
            ["x86_64"],
            "is for arm64, and spec.hardware.arch has x86_64",
        ),
        (of_index(), ["x86_64"], None),
        (lambda _: (200, {}, BODY), ["x86_64"], None),
        (lambda _: (200, {}, b"[]"), ["x86_64"], None),
        (lambda _: (200, {}, b'{"manifests": [1, {"platform": "x"}]}'), ["x86_64"], None),
        (lambda _: (200, {}, b'{"config": {"digest": "../../x"}}'), ["x86_64"], None),
    ],
)
def test_an_image_is_for_the_cpus_that_it_says(
    servers: Any, docker: Any, answer: Callable[[Any], Answer], wanted: list[str], said: str | None
) -> None:
    one = servers()
    docker({})
    one.answer = answer
    if said is None:
        Registry().check(f"{one.address}/robot:v1", ImageUse(architectures=wanted))
        blobs = [path for _, path, *_ in one.seen if "/blobs/" in path]
        assert all(path.startswith("/v2/robot/blobs/sha256:") for path in blobs), "no name that a registry made up"
    else:
        with pytest.raises(InvalidInput, match=said):
            Registry().check(f"{one.address}/robot:v1", ImageUse(architectures=wanted))


def test_the_login_of_machines_is_used_where_the_spec_gives_it_to_them(
    servers: Any, docker: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = servers()
    docker({})
    names = ("SKYPILOT_DOCKER_USERNAME", "SKYPILOT_DOCKER_PASSWORD", "SKYPILOT_DOCKER_SERVER")
    for name, value in zip(names, ("reader", "hunter2", one.address), strict=True):
        monkeypatch.setenv(name, value)
    one.answer = asked_first(of_config("amd64"))
    Registry().check(f"{one.address}/robot:v1", ImageUse(architectures=["x86_64"], secrets=names))
    assert set(one.given) == {BASIC}
    one.seen.clear()
    with pytest.raises(InvalidInput, match=r"does not show it$"):
        Registry().check(f"{one.address}/robot:v1", ImageUse(architectures=["x86_64"]))
    assert one.given == []
    one.answer = lambda _: (401, {"WWW-Authenticate": "Basic realm=x"}, b"")
    with pytest.raises(InvalidInput, match=f"does not show it to the user that {names[0]} and {names[1]} log in"):
        Registry().check(f"{one.address}/robot:v1", ImageUse(architectures=["x86_64"], secrets=names))
    monkeypatch.setenv(names[2], "registry.example")
    with pytest.raises(InvalidInput, match=f"its registry is {one.address}, and {names[2]} names another one"):
        Registry().check(f"{one.address}/robot:v1", ImageUse(architectures=["x86_64"], secrets=names))


def of_content(*bytes_of: object, user: object = "", cpus: tuple[str, ...] = ()) -> Callable[[Any], Answer]:
    """Answer with an image of these layers that runs as a user, in an index if there are `cpus`."""
    config = json.dumps({"os": "linux", "architecture": "amd64", "config": {"User": user}}).encode()
    layers = [{"size": one} for one in bytes_of]
    manifest = json.dumps({"config": {"digest": digest_of(config)}, "layers": layers}).encode()
    listed = [{"platform": {"os": "linux", "architecture": cpu}, "digest": digest_of(manifest)} for cpu in cpus]
    first = json.dumps({"manifests": listed}).encode() if cpus else manifest
    there = {f"blobs/{digest_of(config)}": config, f"manifests/{digest_of(manifest)}": manifest, "manifests/v1": first}
    return lambda request: (200, {}, there[request.path.removeprefix("/v2/robot/")])


def digest_of(content: bytes) -> str:
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


@pytest.mark.parametrize("cpus", [(), ("arm64", "amd64")])
def test_a_large_image_needs_time_to_be_pulled(servers: Any, docker: Any, cpus: tuple[str, ...]) -> None:
    one = servers()
    docker({})
    one.answer = of_content(8 * 2**30, 2**30, cpus=cpus)
    timeout = "spec.benchmark.ready_timeout"
    needs = partial(ImageUse, architectures=["x86_64"], timeout=timeout)
    Registry().check(f"{one.address}/robot:v1", needs(timeout_s=810.0))
    with pytest.raises(
        InvalidInput, match=r"9\.0 GiB \(compressed\) may take 14min .* assumed; .* is 5min$"
    ) as refused:
        Registry().check(f"{one.address}/robot:v1", needs(timeout_s=300.0))
    assert refused.value.hints[0].startswith(f"set {timeout}: 19min, and compile again")


@pytest.mark.parametrize("sizes", [("9999999999",), (-5, 10), (None,), (10**400,)])
def test_a_size_that_is_none_is_not_known(servers: Any, docker: Any, sizes: tuple[Any, ...]) -> None:
    one = servers()
    docker({})
    one.answer = of_content(*sizes)
    Registry().check(f"{one.address}/robot:v1", ImageUse(architectures=["x86_64"], timeout_s=0.1))


@pytest.mark.parametrize(
    ("user", "exported", "fine"),
    [
        ("", None, True),
        ("root", None, True),
        ("0:0", None, True),
        ("root:1000", None, True),
        ("1000:root", None, False),
        (7, None, True),
        ("ros", None, False),
        ("1000", None, False),
        ("ros", "ros", True),
        ("ros", "other", False),
    ],
)
def test_skypilot_logs_in_as_the_images_user(
    servers: Any, docker: Any, monkeypatch: pytest.MonkeyPatch, user: object, exported: str | None, fine: bool
) -> None:
    one, variable = servers(), "SKYPILOT_RUNPOD_DOCKER_USERNAME"
    docker({})
    one.answer = of_content(5, user=user, cpus=("amd64",))
    use = ImageUse(architectures=["x86_64"], user_variable=variable, secrets=[variable] if exported else [])
    if exported is not None:
        monkeypatch.setenv(variable, exported)
    Registry().check(f"{one.address}/robot:v1", replace(use, user_variable=None))
    if fine:
        Registry().check(f"{one.address}/robot:v1", use)
    else:
        with pytest.raises(InvalidInput, match=f"its USER is {user}, and SkyPilot logs in as root") as refused:
            Registry().check(f"{one.address}/robot:v1", use)
        assert refused.value.hints[1] == f"or add {variable} to spec.secrets, and export it with that name"


# What docker keeps


def helper(folder: Path, name: str, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / f"docker-credential-{name}"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")


@pytest.mark.parametrize("where", ["credHelpers", "credsStore"])
@pytest.mark.parametrize(
    ("script", "given"),
    [
        ('read key; printf \'{"Username": "reader", "Secret": "%s"}\' "$key"', "reader:{key}"),
        ("exit 1", None),
        ('read key; printf \'{"Username": "reader", "Secret": "%s"}\' "$key"; exit 1', None),
        ("echo no json", None),
        ('echo \'{"Username": "reader"}\'', None),
    ],
)
def test_a_helper_is_asked_for_the_registry(
    servers: Any,
    docker: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    script: str,
    given: str | None,
) -> None:
    one = servers()
    helper(tmp_path, "pass", script, monkeypatch)
    docker({where: {one.address: "pass"} if where == "credHelpers" else "pass"})
    one.answer = asked_first(lambda _: (200, {}, BODY))
    if given is None:
        with pytest.raises(InvalidInput, match="does not show it"):
            Registry().digest(f"{one.address}/robot:v1")
        assert one.given == []
    else:
        assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
        packed = base64.b64encode(given.format(key=one.address).encode()).decode()
        assert one.given == [f"Basic {packed}"]


def test_a_helpers_token_is_an_identity_token(
    servers: Any, docker: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, tokens = servers(), servers()
    helper(tmp_path, "pass", 'echo \'{"Username": "<token>", "Secret": "hunter2"}\'', monkeypatch)
    docker({"credsStore": "pass"})
    one.answer = asked_first(lambda _: (200, {}, BODY), f'Bearer realm="http://{tokens.address}/token"')
    tokens.answer = lambda _: (200, {}, b'{"token": "t"}')
    Registry().digest(f"{one.address}/robot:v1")
    assert [(method, b"hunter2" in body) for method, *_, body in tokens.seen] == [("POST", True)]


@pytest.mark.parametrize("name", ["../evil", "/tmp/evil", "a/b"])
def test_a_helper_is_a_name_and_no_path(servers: Any, docker: Any, tmp_path: Path, name: str) -> None:
    one = servers()
    docker({"credsStore": name})
    one.answer = asked_first(lambda _: (200, {}, BODY))
    with pytest.raises(InvalidInput, match="does not show it"):
        Registry().digest(f"{one.address}/robot:v1")


@pytest.mark.parametrize("key", ["{}", "https://{}", "http://{}"])
def test_a_login_is_found_as_docker_writes_it_and_not_for_another_registry(servers: Any, docker: Any, key: str) -> None:
    one = servers()
    one.answer = asked_first(lambda _: (200, {}, BODY))
    docker(login(key.format(one.address)))
    assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
    docker(login("registry.example"))
    with pytest.raises(InvalidInput):
        Registry().digest(f"{one.address}/robot:v1")
    assert one.given == [BASIC]


@pytest.mark.parametrize("config", ["{", "[]", '{"auths": {"ADDRESS": []}}', "\udcff"])
def test_a_damaged_configuration_is_named_and_shows_nothing(
    servers: Any, docker: Any, tmp_path: Path, config: str
) -> None:
    one = servers()
    one.answer = asked_first(lambda _: (200, {}, BODY))
    docker({})
    (tmp_path / "config.json").write_bytes(config.replace("ADDRESS", one.address).encode("utf-8", "surrogateescape"))
    with pytest.raises(InvalidInput, match=r"config\.json: docker's configuration cannot be read: \w+$"):
        Registry().digest(f"{one.address}/robot:v1")


def test_a_redirect_on_loopback_is_followed_without_credentials(servers: Any, docker: Any) -> None:
    one, other = servers(), servers()
    docker({})
    one.answer = lambda _: (302, {"Location": f"http://{other.address}/elsewhere"}, b"")
    assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
    assert [path for _, path, *_ in other.seen] == ["/elsewhere"]


def test_a_public_image_needs_no_login_for_its_token(servers: Any, docker: Any) -> None:
    one, tokens = servers(), servers()
    docker({})
    one.answer = asked_first(lambda _: (200, {}, BODY), f'Bearer realm="http://{tokens.address}/token",service="s"')
    tokens.answer = lambda _: (200, {}, b'{"token": "anonymous"}')
    assert Registry().digest(f"{one.address}/robot:v1") == DIGEST
    assert (one.given, tokens.given) == (["Bearer anonymous"], [])


@pytest.mark.parametrize("key", ["https://index.docker.io/v1/", "index.docker.io", "docker.io", "registry-1.docker.io"])
def test_docker_hub_has_several_names(docker: Any, key: str) -> None:
    docker(login(key))
    assert credentials("docker.io") == ("reader", "hunter2")
    assert credentials("ghcr.io") is None
    assert "hunter2" not in repr(credentials("docker.io"))


def test_without_a_word_of_where_it_is_the_configuration_is_at_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DOCKER_CONFIG", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert credentials("ghcr.io") is None
    (tmp_path / ".docker").mkdir()
    (tmp_path / ".docker/config.json").write_text(json.dumps(login("ghcr.io")))
    assert credentials("ghcr.io") == ("reader", "hunter2")


@pytest.mark.parametrize("name", ["../evil", "a/evil"])
def test_no_program_of_the_working_folder_is_a_helper(
    docker: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    ran = tmp_path / "ran"
    planted = tmp_path / f"docker-credential-{name.partition('/')[0]}" / "evil"
    planted.parent.mkdir()
    planted.write_text(f"#!/bin/sh\ntouch {ran}\n")
    planted.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    docker({"credsStore": name})
    assert credentials("ghcr.io") is None
    assert not ran.exists()


@pytest.mark.parametrize("answer", [b"{}", b'{"token": 7}', b'{"token": {"a": 1}}', b"[]", b'"token"'])
def test_a_token_is_a_text(servers: Any, docker: Any, answer: bytes) -> None:
    one, tokens = servers(), servers()
    docker({})
    one.answer = asked_first(lambda _: (200, {}, BODY), f'Bearer realm="http://{tokens.address}/token",service="s"')
    tokens.answer = lambda _: (200, {}, answer)
    with pytest.raises((InvalidInput, CloudError), match="its token server sent no token"):
        Registry().digest(f"{one.address}/robot:v1")
    assert one.given == []
