"""One account for all tests here, and one bench that several look at."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fogspec.backends.skypilot.client import Client
from tests.aws.site import AwsSite, Instance, until
from tests.slurm.abandoned import ABANDONED, Abandoned
from tests.slurm.site import Bench
from tests.tools import apart
from tests.tools.aws import engine
from tests.tools.aws.__main__ import missing
from tests.tools.slurm.engine import start

TYPES = ("c6i.large", "m6i.large", "c6i.xlarge")


@dataclass
class Benched:
    """A project whose application was measured: how many machines at once, what was left right afterwards, and EC2's list."""

    site: AwsSite
    spec: str
    at_once: int
    left: list[str]
    instances: list[Instance]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Machines are slow to set up on a busy machine."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(1800))


@pytest.fixture(scope="session")
def account() -> Path:
    """The folder of the account beside which this runs."""
    folder = Path(os.environ.get(apart.FOLDER, "/nowhere"))
    if not (folder / "images.json").exists():
        pytest.skip(missing() or "needs an account: make aws-test")
    start(engine.environment(folder))
    return folder


@pytest.fixture(scope="session", autouse=True)
def begun(request: pytest.FixtureRequest) -> None:
    """Begin first, and beside all else, what waits for minutes and computes nothing."""
    for name in ("silent", "abandoned"):
        if any(name in getattr(item, "fixturenames", ()) for item in request.session.items):
            request.getfixturevalue(name)


@pytest.fixture(scope="session")
def abandoned(account: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Abandoned]:
    """A machine that runs a compiled task which hangs, with a lifetime of a minute."""
    site = AwsSite(account, tmp_path_factory.mktemp("abandoned") / "project", prefix=ABANDONED)
    site.compile(site.write("hangs", ["c6i.xlarge"]))
    with Client() as client:
        machine = Abandoned(site, client, engine.environment(account), site.task("hangs", "c6i.xlarge"))
        machine.start()
        until(lambda: site.jobs())
        yield machine


@pytest.fixture(scope="session")
def silent(account: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[AwsSite, Bench]]:
    """A bench whose machine is up and never answers SSH."""
    site = AwsSite(account, tmp_path_factory.mktemp("silent") / "project")
    spec = site.write("silent", ["m6i.xlarge"])
    site.edit(spec, "ready_timeout: 20min", "ready_timeout: 10s")
    site.edit(spec, "duration: 1min", "duration: 20s")  # so that it is over before SkyPilot gives up by itself
    site.prefix = site.machine("silent")
    engine.ask("/_fault", action="boot", match=site.prefix, how="silent")
    site.compile(spec)
    bench = site.bench(spec)
    until(lambda: site.jobs() and engine.ask("/_waiting") == [], site.patience_s)
    yield site, bench
    bench.process.kill()


@pytest.fixture
def site(account: Path, tmp_path: Path) -> Iterator[AwsSite]:
    """An empty project; what was to go wrong for it goes wrong for no other."""
    yield AwsSite(account, tmp_path / "project")
    engine.ask("/_clear")


@pytest.fixture(scope="session")
def benched(account: Path, tmp_path_factory: pytest.TempPathFactory) -> Benched:
    """An application that was measured on three types at once."""
    site = AwsSite(account, tmp_path_factory.mktemp("benched") / "project")
    spec = site.write("life", list(TYPES))
    site.edit(spec, "alpha: 0.5", "alpha: 0")
    site.edit(spec, "cpus: 1..128", "cpus: 2..4")
    site.compile(spec)
    bench = site.bench(spec)
    assert bench.ended() == 0
    left, instances = site.left(), site.instances()
    site.compile(spec)
    return Benched(site, spec, bench.at_once, left, instances)
