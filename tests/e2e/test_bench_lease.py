"""A bench that spends money holds the lease of the application, which all clones see, until it ends or loses it."""

import itertools
import subprocess
from pathlib import Path
from typing import Any

import pytest

from fogspec.base.layout import Layout
from fogspec.deploy import shared_state
from fogspec.deploy.shared_state import SharedRecord, holding
from fogspec.deploy.state import SystemWallClock
from tests.corners.test_no_access import AT, bench, cloud, results  # noqa: F401
from tests.support.fake_sky import Cloud
from tests.support.running import Shell, shell  # noqa: F401

PROJECT = "apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {state: git}\n"
FILE = "state.yaml"


def git(*words: str, folder: Path, given: str | None = None) -> str:
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    return subprocess.run(
        ["git", *who, *words], cwd=folder, check=True, capture_output=True, text=True, input=given
    ).stdout.strip()


@pytest.fixture
def remote(shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("FOGSPEC_STATE", raising=False)
    monkeypatch.setattr(shared_state, "KEPT_S", -1.0)
    made = shell.folder.parent / "remote.git"
    git("init", "-q", "--bare", str(made), folder=shell.folder)
    git("init", "-q", folder=shell.folder)
    git("remote", "add", "origin", str(made), folder=shell.folder)
    shell.write("fogspec.yaml", PROJECT)
    return made


def records(remote: Path) -> list[str]:
    refs = git("for-each-ref", "--format=%(refname)", folder=remote).split()
    return [git("show", f"{ref}:{FILE}", folder=remote) for ref in refs]


def test_a_bench_waits_for_what_holds_the_lease(shell: Shell, cloud: Cloud, remote: Path) -> None:
    clone = shell.folder.parent / "clone"
    (clone / "specs").mkdir(parents=True)
    git("init", "-q", folder=clone)
    git("remote", "add", "origin", str(remote), folder=clone)
    (clone / "fogspec.yaml").write_text(PROJECT)
    with holding(Layout.of(clone / "specs/demo.yaml", "demo"), "watch of demo", SystemWallClock(), print):
        said = bench(shell, code=8).err
    assert "bench of demo must wait: watch of demo on" in said
    assert cloud.machines == {}
    assert records(remote) == []


def test_a_bench_holds_the_lease_while_it_has_machines(
    shell: Shell, cloud: Cloud, remote: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch, seen = cloud.launch, list[list[str]]()

    def noted(**words: Any) -> dict[str, Any]:
        seen.append(records(remote))
        return launch(**words)

    monkeypatch.setattr(cloud, "launch", noted)
    bench(shell)
    assert len(seen) == 4
    assert all("what: bench of demo" in one for (one,) in seen)
    assert records(remote) == [], "nothing runs, and there is no history"
    shell("bench", "specs/demo.yaml", "--runner", "local", "--dry-run", code=None)
    assert records(remote) == []


def test_a_bench_that_lost_its_lease_ends_its_machines_and_keeps_what_it_measured(
    shell: Shell, cloud: Cloud, remote: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch, take, held, number = cloud.launch, SharedRecord.take, list[SharedRecord](), itertools.count(1)

    def taken(self: SharedRecord, salvage: bool = False) -> None:
        held.append(self)
        take(self, salvage)

    def overtaken(**words: Any) -> dict[str, Any]:
        """Another computer writes itself into the record while a second machine is requested."""
        if next(number) == 2:
            (ref,) = git("for-each-ref", "--format=%(refname)", folder=remote).split()
            text = git("show", f"{ref}:{FILE}", folder=remote).replace(held[0].holder, "0" * 16)
            blob = git("hash-object", "-w", "--stdin", folder=remote, given=f"{text}\n")
            tree = git("mktree", folder=remote, given=f"100644 blob {blob}\t{FILE}\n")
            git("update-ref", ref, git("commit-tree", tree, "-m", "theirs", folder=remote), folder=remote)
            held[0].renew()
        return launch(**words)

    monkeypatch.setattr(SharedRecord, "take", taken)
    monkeypatch.setattr(cloud, "launch", overtaken)
    said = bench(shell, "--at-once", "1", code=8).err
    assert "bench of demo: another command took over its state while this one had no contact" in said
    assert cloud.machines == {}
    kept = results(shell)["samples"]
    assert [one["state"] for one in kept].count("ok") == 1
    assert "0000000000000000" in records(remote)[0], "what the other one wrote stays"
