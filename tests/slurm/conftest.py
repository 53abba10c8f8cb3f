"""One cluster for all tests here; one bench that several look at; one machine nobody looks after."""

import os
import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fogspec.backends.skypilot.client import Client
from tests.slurm import robot
from tests.slurm.abandoned import ABANDONED, Abandoned
from tests.slurm.looking import Looking
from tests.slurm.site import Site
from tests.tools import apart
from tests.tools.slurm import engine
from tests.tools.slurm.__main__ import missing

SECRET = f"hunter2-{secrets.token_hex(8)}"  # of this run: what another one left in a shared folder is not found
# Tells its secret in a log, and in the record of the first request, which is not counted.
TELLS = """\
print(os.environ["MAP_PASSWORD"], flush=True)
fogspec_probe.start("work")
fogspec_probe.stop("work", ok=False, reason="refused " + os.environ["MAP_PASSWORD"])
"""
SHAPES = {"2CPU--4GB": 0.085, "2CPU--16GB": 0.126, "16CPU--32GB": 0.68, "64CPU--128GB": 2.72}


@dataclass
class Benched:
    """A project whose application was measured: how many machines at once, what was left, and what others saw of it."""

    site: Site
    spec: str
    at_once: int
    left: list[str]
    seen: Looking


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """An engine is slow on a busy machine."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(1800))


@pytest.fixture(scope="session")
def cluster() -> Path:
    """The folder of the cluster beside which this runs."""
    if apart.FOLDER not in os.environ:
        pytest.skip(missing() or "needs a cluster: make slurm-test")
    folder = Path(os.environ[apart.FOLDER])
    engine.start(engine.environment(folder))
    return folder


@pytest.fixture
def site(cluster: Path, tmp_path: Path) -> Site:
    """An empty project."""
    return Site(cluster, tmp_path / "project")


@pytest.fixture(scope="session")
def abandoned(cluster: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Abandoned]:
    """A machine that runs a compiled task which hangs; it is started beside what else is tested."""
    site = Site(cluster, tmp_path_factory.mktemp("abandoned"))
    site.compile(site.write("hangs", ["4CPU--16GB--T4:1"]))
    with Client() as client:
        machine = Abandoned(site, client, engine.environment(cluster), site.task("hangs", "4CPU--16GB--T4:1"))
        machine.start()
        yield machine


@pytest.fixture(scope="session")
def benched(cluster: Path, abandoned: Abandoned, tmp_path_factory: pytest.TempPathFactory) -> Benched:
    """An application with a robot and a secret that was measured on four machines at once."""
    site = Site(cluster, tmp_path_factory.mktemp("benched") / "project")
    spec = site.write("life", list(SHAPES))
    path = site.project / spec
    text = path.read_text().replace("alpha: 0.5", "alpha: 0").replace("cpus: 1..128", "cpus: 2..64")
    path.write_text(text.replace("  benchmark:", "  secrets: [MAP_PASSWORD]\n  benchmark:"))
    robot.write(site, spec, TELLS)
    os.environ["MAP_PASSWORD"] = SECRET
    site.compile(spec)
    with Looking(SECRET) as seen:
        bench = site.bench(spec)
        assert bench.ended() == 0
    abandoned.up()
    left = site.left(spare=ABANDONED)
    site.compile(spec)
    return Benched(site, spec, bench.at_once, left, seen)
