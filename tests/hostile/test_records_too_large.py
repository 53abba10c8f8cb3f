"""Records that are no files, or larger than any memory: `down` ends what runs, names them, and no verb dies of them."""

import os
import resource
import shutil
from pathlib import Path

import pytest

from fogspec.backends import registry
from fogspec.base.errors import NotInstalled
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.forking import Ended, forked

RECORDS = (
    "compiled/tiny/plan.yaml",
    "compiled/tiny/manifest.yaml",
    "specs/tiny.yaml",
    ".fogspec/tiny/deployment.yaml",
    ".fogspec/tiny/journal.jsonl",
)
SPARSE = 300 << 30  # bytes, none of them on the disk
MOST_MEMORY = 1 << 30  # bytes of address space beyond what is loaded


def sparse(path: Path) -> None:
    with path.open("ab") as file:
        file.truncate(SPARSE)


def folder(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.mkdir()


def pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def garbage(path: Path) -> None:
    path.write_bytes(b"\0\n" * 99)


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def limited() -> None:
    """Where memory ends, and SkyPilot is not installed."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MOST_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    host = registry.deployment_backend

    def absent(infra: str) -> object:
        if infra != "local":
            raise NotInstalled("SkyPilot is not installed here")
        return host(infra)

    registry.deployment_backend = absent  # type: ignore[assignment]


def run(app: Deployed, *words: str) -> Ended:
    return forked(app.folder, words, first=limited)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDS)
def test_down_ends_what_it_can_and_names_the_record(tiny: Deployed, name: str) -> None:
    path = tiny.folder / name
    kept = path.read_bytes() if path.exists() else b""
    for place in (sparse, folder, pipe, garbage):
        tiny.apply()
        place(path)
        ended = run(tiny, "down", "tiny")
        said = f"{place.__name__}: {ended}"
        assert (ended.returncode, tiny.alive()) == (6, []), said
        assert f"{name}: cannot be read" in ended.stderr, said
        assert "not everything could be verified gone" in ended.stderr, said
        remove(path)
        path.write_bytes(kept)
        tiny("down", "tiny")


def test_down_ends_what_runs_though_a_link_stands_for_its_record(tiny: Deployed) -> None:
    tiny.apply()
    path = tiny.state / "deployment.yaml"
    path.unlink()
    path.symlink_to("/dev/zero")
    ended = run(tiny, "down", "tiny")
    assert (ended.returncode, tiny.alive()) == (6, []), ended
    assert "deployment.yaml: it is a link" in ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", [*RECORDS, "compiled/tiny/scripts/measure.sh", "results/tiny/local-1cpu-1gib.yaml"])
def test_no_verb_dies_of_a_record(tiny: Deployed, name: str) -> None:
    tiny.apply()
    for place in (sparse, pipe):
        place(tiny.folder / name)
        for words in (
            ["bench", "tiny", "--runner", "local"],
            ["status"],
            ["bench", "tiny", "--dry-run"],
            ["apply", "tiny", "--adopt"],
            ["diff"],
        ):
            ended = run(tiny, *words)
            assert 0 <= ended.returncode < 10, f"{place.__name__}, {words}: {ended}"
