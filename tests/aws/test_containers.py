"""Nodes in an image of a private registry, by SkyPilot's own docker code on AWS's API: lock, bench, apply, update, down."""

import gzip
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fogspec.results.io import read_results_folder
from tests.aws.site import AwsSite, until
from tests.aws.test_line import deployed, status
from tests.support.registries import PASSWORD, USER
from tests.tools.aws import images
from tests.tools.aws.images import Images

SECRET = "a-key-of-the-team-5e1c"
LOGIN = {
    "SKYPILOT_DOCKER_USERNAME": USER,
    "SKYPILOT_DOCKER_PASSWORD": PASSWORD,
    "SKYPILOT_DOCKER_SERVER": images.REGISTRY,
}
# What the node sees it says in its log: also its secret, which must not be in what fogspec keeps.
WORK = """\
import hashlib
import os
import time

import fogspec_probe

login = sorted(name for name in os.environ if name.startswith("SKYPILOT_DOCKER_"))
key = os.environ["TEAM_KEY"]
print("sees", os.environ["TEAM_IMAGE"], login, os.path.exists("/run/.containerenv"), flush=True)
print("key", key, hashlib.sha256(key.encode()).hexdigest(), flush=True)
while True:
    fogspec_probe.start("work")
    time.sleep(0.05)
    fogspec_probe.stop("work")
"""


@dataclass
class ContainerSite(AwsSite):
    """A project of a user who is logged in to the registry and has the secrets in the environment."""

    extra: dict[str, str] = field(default_factory=dict)

    def _env(self) -> dict[str, str]:
        return super()._env() | self.extra


@pytest.fixture(scope="module")
def registry(account: Path) -> Iterator[Images]:
    """A private registry with one image."""
    if why := images.missing():
        pytest.skip(why)
    found = Images(account)
    with found.served():
        yield found


@pytest.fixture(scope="module")
def site(account: Path, registry: Images, tmp_path_factory: pytest.TempPathFactory) -> ContainerSite:
    """A project with a spec."""
    folder = tmp_path_factory.mktemp("containers")
    registry.log_in(folder / "docker")
    extra = {"DOCKER_CONFIG": str(folder / "docker"), "SSL_CERT_FILE": str(registry.certificate), "TEAM_KEY": SECRET}
    site = ContainerSite(account, folder / "project", extra=extra | LOGIN)
    spec = site.write("life", ["m6i.large"], work=WORK)
    ros = f"ros: {{distro: jazzy, image: '{registry.name}:latest'}}"
    site.edit(spec, "  probe:", f"  {ros}\n  secrets: [{', '.join(['TEAM_KEY', *LOGIN])}]\n  probe:")
    return site


@pytest.mark.rare
def test_an_image_of_a_private_registry_from_the_lock_to_the_end(site: ContainerSite, registry: Images) -> None:
    spec, manifest = "specs/life/life.yaml", "compiled/life/manifest.yaml"
    first = registry.push("1")
    site.run("lock", spec)
    site.compile(spec)
    assert site.task("life", "m6i.large")["resources"]["image_id"] == f"docker:{registry.name}@{first}"

    bench = site.bench(spec)
    assert bench.ended() == 0, (site.project / "bench.log").read_text()
    (record,) = site.results("life").values()
    assert (record.state, record.requests >= 20) == ("ok", True)
    assert read_results_folder(site.project / "results" / "life").spec.inputs["image"] == first
    assert site.left() == []

    site.compile(spec)
    assert f"{registry.name}@{first}" in (site.project / manifest).read_text()
    site.run("check", spec)
    site.run("apply", manifest, "--yes")
    (machine,) = deployed(site)
    assert (machine["state"], machine["image"]) == ("serving", f"{registry.name}@{first}")
    assert status(site, spec)["sync"] == "Synced"
    said = site.run("logs", "life").stdout
    assert f"sees 1 [] True\nkey $TEAM_KEY {hashlib.sha256(SECRET.encode()).hexdigest()}" in said
    until(lambda: (status(site, spec)["observed"] or {}).get("p50_s"))  # of requests that it answers

    second = registry.push("2")
    site.compile(spec)
    assert status(site, spec)["sync"] == "Synced", "a tag that moves changes nothing"
    assert f"{first} -> {second}" in site.run("lock", spec, "--upgrade", f"{registry.name}:latest").stdout
    site.run("apply", manifest, "--yes", code=3)
    waiver = f"{{change: image, old: '{first}', new: '{second}', reason: the same planner}}"
    site.edit(spec, "    warmup:", f"    waivers: [{waiver}]\n    warmup:")
    site.compile(spec)
    site.run("apply", manifest, "--yes")
    (machine,) = deployed(site)
    assert (machine["state"], machine["image"]) == ("serving", f"{registry.name}@{second}")
    assert "sees 2 [] True" in site.run("logs", "life").stdout

    assert "nothing is left" in site.run("down", "life").stdout
    assert site.left() == []
    kept = [path for path in site.project.rglob("*") if path.is_file()]
    whole = [gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes() for path in kept]
    for value in (SECRET, PASSWORD):
        assert [path for path, content in zip(kept, whole, strict=True) if value.encode() in content] == []
