"""One cluster for all tests here, brought up if none is, and one machine in it that nobody looks after."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.slurm.site import Site
from tests.tools.slurm import daemons, engine
from tests.tools.slurm.__main__ import default_folder, down, missing, up

ABANDONED = "fogspec-abandoned"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """An engine is slow on a busy machine."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(600))


@pytest.fixture(scope="session")
def cluster() -> Iterator[Path]:
    """The cluster's folder; one that is up already is used, and stays."""
    folder = default_folder()
    was_up = daemons.living(folder, "slurmctld") is not None
    if not was_up:
        if why := missing():
            pytest.skip(f"{why}; then: make slurm-up")
        up(folder)
    yield folder
    if not was_up:
        down(folder)


@pytest.fixture
def site(cluster: Path, tmp_path: Path) -> Site:
    """An empty project."""
    return Site(cluster, tmp_path / "project")


@pytest.fixture
def own_sky(cluster: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cluster's SkyPilot for what runs in this process."""
    for name in set(os.environ) - set(given := engine.environment(cluster)):
        monkeypatch.delenv(name)
    for name, value in given.items():
        monkeypatch.setenv(name, value)


@pytest.fixture(scope="session")
def abandoned(cluster: Path, tmp_path_factory: pytest.TempPathFactory) -> float:
    """A machine that runs a compiled task which hangs, with a lifetime of a minute; when it was launched."""
    from fogspec.plugins.skypilot.client import Client

    site = Site(cluster, tmp_path_factory.mktemp("abandoned"))
    site.compile(site.write("hangs", ["4CPU--16GB--T4:1"]))
    task = site.task("hangs", "4CPU--16GB--T4:1")
    task["resources"]["autostop"]["idle_minutes"] = 1
    task["run"] = "sleep 3600"
    before = dict(os.environ)
    os.environ.update(engine.environment(cluster))
    try:
        with Client() as client:
            client.ready()
            request = client.ask("launch", 60, task=task, name=ABANDONED, root=str(site.project))["request"]
            while client.ask("launched", 60, request=request, name=ABANDONED) is None:
                time.sleep(1)
    finally:
        os.environ.clear()
        os.environ.update(before)
    return time.monotonic()
