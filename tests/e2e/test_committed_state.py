"""Live state that came with the checkout: nothing is paid or ended by it, and nothing is said from it."""

import subprocess
from pathlib import Path

import pytest

from tests.e2e.test_hostile_folder import CLOUD
from tests.support.files import write_yaml
from tests.support.running import Shell, measure, project, shell  # noqa: F401

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
def committed(shell: Shell) -> Shell:
    """A project with a live state that names somebody's cloud machine."""
    project(shell)
    measure(shell)
    shell("compile", "specs/demo.yaml", "--catalog", "offers.csv")
    state = {**CLOUD, "metadata": {"name": "demo"}}
    write_yaml(shell.folder / ".fogspec/demo/deployment.yaml", state, "a test")
    return shell


SPENDING = [("bench", "specs/demo.yaml", "--runner", "local"), ("down", "demo"), ("down", "specs/demo.yaml")]


def refused(shell: Shell) -> None:
    state = shell.folder / ".fogspec" / "demo" / "deployment.yaml"
    before = state.read_bytes()
    for words in SPENDING:
        ended = shell(*words, code=5)
        assert "git tracks it: what runs is a record of this computer" in ended.err
        assert "git rm -r --cached .fogspec" in ended.err
    for verb in ("status", "diff"):
        ended = shell(verb, "specs/demo.yaml", "--catalog", "offers.csv")
        assert ended.err.count("ignored: git tracks it") == 1
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
        assert "git tracks it" not in committed(verb, "specs/demo.yaml", "--catalog", "offers.csv", code=None).err
