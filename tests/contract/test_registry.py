"""Digests come from registries by their own protocol: Debian's docker-registry on loopback, open and with a password.

What the client answers to a registry that lies, redirects or is slow: tests/unit/backends/test_registry_loopback.py.
"""

import base64
import hashlib
import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.registries import HTPASSWD, PASSWORD, USER
from tests.support.running import CATALOG, Shell, shell, spec  # noqa: F401

MANIFEST = "application/vnd.oci.image.manifest.v1+json"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def answers(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


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
        while not answers(port):
            assert process.poll() is None, (folder / "log").read_text()
            time.sleep(0.05)
        yield f"127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait()


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
    with urllib.request.urlopen(request, timeout=600) as answer:
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
    shell("compile", "specs/demo.yaml", "--catalog", "offers.csv")
    assert f'code: image_unpinned, image: "{image}"' in shell.read("compiled/demo/plan.yaml")
    project(shell, f"{registry}/robots/nobody:v1")
    assert "has no such image" in shell("lock", code=1).err
    assert not (shell.folder / "specs/demo.lock").exists()
    project(shell, image)
    shell("lock", "--catalog", "offers.csv")
    assert first in shell.read("specs/demo.lock")
    shell("check", code=3)
    shell("compile", "specs/demo.yaml")
    task = shell.read("compiled/demo/tasks/aws-r1-a-small.sky.yaml")
    assert f'image_id: "docker:{registry}/robots/planner@{first}"' in task
    assert "image_unpinned" not in shell.read("compiled/demo/plan.yaml")

    second = push(registry, "robots/planner", "v1", b"second")
    before = shell.read("specs/demo.lock")
    shell("lock")
    assert shell.read("specs/demo.lock") == before, "what is locked stays"
    assert "plan" in shell("lock", "--upgrade", "plan", code=2).err
    said = shell("lock", "--upgrade", image).out
    assert f"{first} -> {second}" in said
    shell("check", "specs/demo.yaml", code=3)


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
    assert digest in shell.read("specs/demo.lock")
    for text in (said.out, said.err, *(path.read_text() for path in shell.folder.rglob("*") if path.is_file())):
        assert PASSWORD not in text
        assert packed not in text
