"""One account for all tests here, and one bench that several look at."""

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.aws.site import AwsSite, Instance
from tests.tools import apart
from tests.tools.aws import engine
from tests.tools.aws.__main__ import missing

TYPES = ("c6i.large", "m6i.large", "c6i.xlarge")


@dataclass
class Benched:
    """A project whose application was measured: in so many seconds, what was left right afterwards, and EC2's list."""

    site: AwsSite
    spec: str
    took_s: float
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
    return folder


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
    begun = time.monotonic()
    assert site.bench(spec).ended() == 0
    took_s = time.monotonic() - begun
    left, instances = site.left(), site.instances()
    site.compile(spec)
    return Benched(site, spec, took_s, left, instances)
