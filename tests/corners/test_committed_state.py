"""Live state that git tracks: nothing is paid or ended by it, nothing is said from it, and it hides no machine."""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from fogspec.backends import registry
from tests.hostile.test_folder import CLOUD
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.fake_sky import Cloud, Machine, beside
from tests.support.files import write_yaml
from tests.support.running import Shell, chosen, project, shell  # noqa: F401

WHO = [
    "-c",
    "user.name=a",
    "-c",
    "user.email=a@example.org",
    "-c",
    "commit.gpgsign=false",
    "-c",
    "protocol.file.allow=always",
]


def git(folder: Path, *words: str) -> None:
    subprocess.run(["git", *WHO, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def committed(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Shell:
    """A project with a live state that names somebody's cloud machine, which runs."""
    cloud = Cloud(shell.folder.parent / "cloud", machines={SOMEBODYS: Machine(shell.folder.parent, 0.0)})
    monkeypatch.setattr(registry, "deployment_backend", beside(registry.deployment_backend, cloud))
    monkeypatch.setattr(Cloud, "end", lambda *_: pytest.fail("somebody's machine was ended"))
    chosen(shell)
    state = {**CLOUD, "metadata": {"name": "demo"}}
    write_yaml(shell.folder / ".fogspec/demo/deployment.yaml", state, "a test")
    return shell


SOMEBODYS = "fogspec-tiny-01234567-abcdef"
SPENDING = [("bench", "specs/demo.yaml", "--runner", "local"), ("down", "demo"), ("down", "specs/demo.yaml")]


def refused(shell: Shell) -> None:
    state = shell.folder / ".fogspec" / "demo" / "deployment.yaml"
    before = state.read_bytes()
    for words in SPENDING:
        ended = shell(*words, code=5)
        assert "git tracks it: what runs is a record of this computer" in ended.err
        assert "git rm -r -f --cached .fogspec" in ended.err
    for words in (["status", "demo"], ["diff", "demo"], ["logs", "demo"]):
        ended = shell(*words, code=5)
        assert ".fogspec" in ended.err
        assert "git tracks it" in ended.err
        assert "fogspec down demo ends what runs" in ended.err
        assert "fogspec-tiny" not in ended.out
    assert state.read_bytes() == before
    assert [path.name for path in state.parent.iterdir() if path.name != ".git"] == ["deployment.yaml"]


def test_state_in_a_commit_is_refused_and_ignored(committed: Shell) -> None:
    git(committed.folder, "init", "-q")
    git(committed.folder, "add", "-f", ".fogspec")
    refused(committed)
    git(committed.folder, "commit", "-q", "-m", "all")
    refused(committed)


def test_so_is_state_of_a_project_in_a_folder_of_the_repository(committed: Shell) -> None:
    git(committed.folder.parent, "init", "-q")
    git(committed.folder.parent, "add", "-f", "project/.fogspec")
    refused(committed)


@pytest.mark.parametrize("where", [".fogspec", ".fogspec/demo"])
def test_so_is_state_that_is_a_submodule(committed: Shell, where: str) -> None:
    folder = committed.folder
    other = folder.parent / "other"
    (folder / where).rename(other)
    git(other, "init", "-q")
    git(other, "add", "-A")
    git(other, "commit", "-q", "-m", "state")
    git(folder, "init", "-q")
    git(folder, "submodule", "add", str(other), where)
    refused(committed)


@pytest.mark.parametrize("how", ["not tracked", "no repository", "no git"])
def test_other_state_is_read(committed: Shell, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if how == "not tracked":
        git(committed.folder, "init", "-q")
        git(committed.folder, "add", "specs")
    if how == "no git":
        monkeypatch.setenv("PATH", "/nowhere")
    for verb in ("status", "diff"):
        assert "git tracks it" not in committed(verb, "specs/demo.yaml", code=None).err


def test_a_project_made_by_hand_keeps_its_live_state_out_of_git(tiny: Deployed) -> None:
    git(tiny.folder, "init", "-q")
    tiny.apply()
    git(tiny.folder, "add", "-A")
    staged = subprocess.run(["git", "ls-files"], cwd=tiny.folder, check=True, capture_output=True, text=True).stdout
    assert "specs/tiny.yaml" in staged
    assert ".fogspec" not in staged
    assert "  running   Synced, " in tiny("status").stdout
    tiny("down", "tiny")
    assert (tiny.machines(), tiny.left()) == ([], [])


def test_down_ends_what_runs_here_though_git_tracks_its_record(tiny: Deployed) -> None:
    git(tiny.folder, "init", "-q")
    tiny.apply()
    git(tiny.folder, "add", "-f", ".fogspec")
    said = tiny("status", code=5)
    assert ".fogspec/tiny/" in said.stderr
    assert "git tracks it" in said.stderr
    assert "nothing" not in said.stdout
    ended = tiny("down", "tiny", code=5)
    assert tiny.alive() == []
    assert "git rm -r -f --cached .fogspec" in ended.stderr
    git(tiny.folder, "rm", "-rfq", "--cached", ".fogspec")
    tiny("down", "tiny")
    assert tiny.left() == []


def test_a_committed_record_ends_nothing_of_another_clone(app: Callable[..., Deployed]) -> None:
    here, other = app(), app()
    for one in (here, other):
        git(one.folder, "init", "-q")
        git(one.folder, "remote", "add", "origin", "https://example.org/robot.git")
    other.apply()
    record = YAML(typ="safe", pure=True).load(other.state / "deployment.yaml")
    record["spec"]["machines"][0]["place"] = {"host": os.uname().nodename, "root": str(other.folder)}
    here.state.mkdir(parents=True)
    write_yaml(here.state / "deployment.yaml", record, "a test")
    git(here.folder, "add", "-f", ".fogspec")
    before = here.machines()
    assert before[0]["place"]["root"] == str(other.folder)
    here("down", "tiny", code=5)
    assert other.alive()
    assert other.status()["sync"] == "Synced"
    assert here.machines() == before
