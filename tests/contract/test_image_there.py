"""Before a machine is started: whether the registry has a pinned image, and for the CPUs of the machines."""

import hashlib
import json
from collections.abc import Iterator
from typing import Any

import pytest
from sky.skylet import constants

from fogspec.backends import registry as backends
from fogspec.backends.images.registry import Registry
from fogspec.backends.skypilot import backend
from fogspec.base.clouds import CLOUDS
from fogspec.language.lockfile import REGISTRY_LOGIN, ImageUse
from tests.contract.test_registry import MANIFEST, free_port, private, project, push, registry, send  # noqa: F401
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.registries import PASSWORD, USER
from tests.support.running import Shell, measure, shell  # noqa: F401

INDEX = "application/vnd.oci.image.index.v1+json"
AT = ("--catalog", "offers.csv")


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cloud]:
    made = Cloud(shell.folder.parent / "cloud")
    monkeypatch.setattr(backends, "sample_backend", lambda _: lambda: backend.SkyPilotSamples(SimulatedClient(made)))
    monkeypatch.setattr(backends, "deployment_backend", lambda _: backend.SkyPilotDeployments(SimulatedClient(made)))
    yield made
    for name in list(made.machines):
        made.end(name)


def push_for(registry: str, name: str, *architectures: str, compressed_bytes: int | None = None) -> str:
    """Push an image for one CPU, or an index of several; return its name by digest."""
    found = [_push_one(registry, name, one, compressed_bytes) for one in architectures]
    content, kind = found[0][0], MANIFEST
    if len(found) > 1:
        listed = [
            {
                "mediaType": MANIFEST,
                "digest": _digest(one),
                "size": len(one),
                "platform": {"os": "linux", "architecture": cpu},
            }
            for one, cpu in found
        ]
        attested = listed[0] | {"platform": {"os": "unknown", "architecture": "unknown"}}
        content, kind = (
            json.dumps({"schemaVersion": 2, "mediaType": INDEX, "manifests": [*listed, attested]}).encode(),
            INDEX,
        )
        send("PUT", f"http://{registry}/v2/{name}/manifests/{_digest(content)}", content, kind)
    return f"{registry}/{name}@{_digest(content)}"


def _push_one(registry: str, name: str, cpu: str, compressed_bytes: int | None) -> tuple[bytes, str]:
    described: list[dict[str, Any]] = []
    config = json.dumps({"os": "linux", "architecture": cpu}).encode()
    for blob, kind in ((config, "config.v1+json"), (cpu.encode(), "layer.v1.tar")):
        where = send("POST", f"http://{registry}/v2/{name}/blobs/uploads/")
        send("PUT", f"{where}&digest={_digest(blob)}", blob)
        described.append({"mediaType": f"application/vnd.oci.image.{kind}", "digest": _digest(blob), "size": len(blob)})
    if compressed_bytes is not None:
        described[1]["size"] = compressed_bytes
    body = {"schemaVersion": 2, "mediaType": MANIFEST, "config": described[0], "layers": described[1:]}
    content = json.dumps(body).encode()
    send("PUT", f"http://{registry}/v2/{name}/manifests/{_digest(content)}", content, MANIFEST)
    return content, cpu


def _digest(content: bytes) -> str:
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def requirement(shell: Shell) -> dict[str, Any]:
    said = json.loads(shell("bench", "demo", "--dry-run", "-o", "json", code=None).out)
    (found,) = [one for one in said if one["what"] == "image"]
    return dict(found)


def bench(shell: Shell, code: int) -> str:
    shell("compile", "specs/demo.yaml", *AT)
    return shell("bench", "demo", "--runner", "skypilot", "--yes", code=code).err


@pytest.mark.parametrize("cpus", [("amd64",), ("arm64", "amd64")])
def test_an_image_for_the_machines_cpus_is_fine(
    registry: str, shell: Shell, cloud: Cloud, cpus: tuple[str, ...]
) -> None:
    project(shell, push_for(registry, "robots/fine", *cpus))
    assert (requirement(shell)["state"], requirement(shell)["fixes"]) == ("ok", [])


def test_an_image_for_another_cpu_starts_no_machine(registry: str, shell: Shell, cloud: Cloud) -> None:
    image = push_for(registry, "robots/pi", "arm64")
    project(shell, image)
    found, wrong = requirement(shell), f"{image}: is for arm64, and spec.hardware.arch has x86_64"
    assert (found["state"], found["detail"]) == ("problem", wrong)
    assert found["fixes"] == ["build and push it for linux/amd64, or change spec.hardware.arch"]
    said = bench(shell, code=1)
    assert wrong in said
    assert found["fixes"][0] in said
    assert cloud.machines == {}
    assert not (shell.folder / "results").exists()


def test_an_image_that_takes_longer_than_it_may_starts_no_machine(registry: str, shell: Shell, cloud: Cloud) -> None:
    image = push_for(registry, "robots/large", "amd64", compressed_bytes=8 * 2**30)
    project(shell, image)
    found = requirement(shell)
    assert found["state"] == "problem"
    assert found["detail"].startswith(f"{image}: to pull its 8.0 GiB (compressed) may take 12min at ")
    assert found["fixes"] == ["set spec.benchmark.ready_timeout: 13min, and compile again; or make the image smaller"]
    assert found["detail"] in bench(shell, code=1)
    assert cloud.machines == {}
    shell.write("specs/demo.yaml", shell.read("specs/demo.yaml").replace("ready_timeout: 1min", "ready_timeout: 13min"))
    assert requirement(shell)["state"] == "ok"


def test_the_user_of_an_image_is_told_to_skypilot_by_its_own_variable() -> None:
    assert CLOUDS["runpod"].user_variable == constants.RUNPOD_DOCKER_USERNAME_ENV_VAR


def test_an_image_that_is_gone_starts_no_machine(registry: str, shell: Shell, cloud: Cloud) -> None:
    image = f"{registry}/robots/gone@sha256:{'0' * 64}"
    project(shell, image)
    found = requirement(shell)
    assert (found["state"], found["detail"]) == ("problem", f"{image}: the registry {registry} has no such image")
    assert "fogspec lock specs/demo.yaml --upgrade all" in found["fixes"][0]
    assert found["detail"] in bench(shell, code=1)
    assert cloud.machines == {}


def test_a_registry_that_does_not_tell_is_not_checked(private: str, shell: Shell, cloud: Cloud) -> None:
    digest = push(private, "robots/hidden", "v1", b"layer", user=True)
    project(shell, f"{private}/robots/hidden@{digest}")
    found = requirement(shell)
    assert found["state"] == "not checked", "a machine may have another login"
    assert f"docker login {private}" in found["fixes"]
    silent = f"127.0.0.1:{free_port()}"
    project(shell, f"{silent}/robots/hidden@{digest}")
    found = requirement(shell)
    assert (found["state"], "cannot be asked" in found["detail"]) == ("not checked", True)
    assert found["fixes"] == [f"docker manifest inspect {silent}/robots/hidden@{digest}"]


@pytest.fixture
def hidden(private: str, shell: Shell, cloud: Cloud) -> str:
    """An image that is shown to one user, in the spec of machines that log in with the spec's secrets."""
    image = f"{private}/robots/login@{push(private, 'robots/login', 'v1', b'layer', user=True)}"
    project(shell, image)
    before = shell.read("specs/demo.yaml")
    shell.write(
        "specs/demo.yaml", before.replace("\n  probe:", f"\n  secrets: [{', '.join(REGISTRY_LOGIN)}]\n  probe:", 1)
    )
    return image


def log_in(monkeypatch: pytest.MonkeyPatch, server: str, password: str = PASSWORD) -> None:
    for name, value in zip(REGISTRY_LOGIN, (USER, password, server), strict=True):
        monkeypatch.setenv(name, value)


def test_the_login_of_the_machines_is_what_shows_an_image(
    hidden: str, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_in(monkeypatch, hidden.partition("/")[0])
    assert (requirement(shell)["state"], requirement(shell)["fixes"]) == ("ok", [])


def test_a_wrong_password_of_the_machines_starts_none(
    hidden: str, shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = hidden.partition("/")[0]
    log_in(monkeypatch, registry, "not-the-password")
    found, said = requirement(shell), bench(shell, code=1)
    assert (found["state"], found["fixes"]) == (
        "problem",
        [f"export the values with which this works: docker login {registry}"],
    )
    assert f"{hidden}: the registry {registry} does not show it to the user that " in found["detail"]
    assert found["detail"] in said
    assert "not-the-password" not in said + str(found)
    assert cloud.machines == {}
    assert not (shell.folder / "results").exists()


def test_an_apply_with_a_wrong_password_starts_no_machine(
    hidden: str, shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_in(monkeypatch, hidden.partition("/")[0])
    shell("compile", "specs/demo.yaml", *AT)
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    log_in(monkeypatch, hidden.partition("/")[0], "not-the-password")
    said = shell("apply", "demo", "--yes", code=1).err
    assert f"{hidden}: the registry {hidden.partition('/')[0]} does not show it to the user that " in said
    assert cloud.machines == {}


@pytest.mark.parametrize("server", ["registry.example.org", "https://{}", ""])
def test_a_login_to_another_registry_starts_no_machine(
    hidden: str, shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch, server: str
) -> None:
    registry = hidden.partition("/")[0]
    log_in(monkeypatch, server.format(registry))
    found = requirement(shell)
    wrong = f"{hidden}: its registry is {registry}, and SKYPILOT_DOCKER_SERVER names another one"
    assert (found["state"], found["detail"]) == ("problem", wrong)
    assert found["fixes"] == [f"export SKYPILOT_DOCKER_SERVER={registry}"]
    assert wrong in bench(shell, code=1)
    assert cloud.machines == {}


def test_what_does_not_say_its_cpu_passes(registry: str) -> None:
    image = f"{registry}/robots/plain@{push(registry, 'robots/plain', 'v1', b'layer')}"
    Registry().check(image, ImageUse(architectures=["x86_64", "arm64"]))
