"""Git's merges of branches that were compiled, with the driver registered as the documentation says."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.test_review import change, commit, git, repository  # noqa: F401
from tests.support.running import Shell, shell, spec  # noqa: F401

PAGE = Path(__file__).resolve().parents[2] / "docs/howto/editor-and-ci.md"


@pytest.fixture
def branches(repository: Shell) -> Shell:
    """Two branches that change one spec in different lines, each compiled; `main` is checked out."""
    shell = repository
    assert "merge.fogspec.driver 'fogspec merge-driver %A %P'" in PAGE.read_text("utf-8")
    git(shell.folder, "config", "merge.fogspec.driver", f"{sys.executable} -m fogspec merge-driver %A %P")
    git(shell.folder, "config", "user.name", "a")
    git(shell.folder, "config", "user.email", "a@example.org")
    # The body is apart, so that lines of git's are no conflict by themselves.
    shell.write("specs/demo.yaml", shell.read("specs/demo.yaml").replace("  ", "\n\n\n  "))
    shell.write(".gitattributes", "compiled/** linguist-generated merge=fogspec\n")
    shell("compile")
    commit(shell, "apart")
    for branch, old, new in (("theirs", "alpha: 0.5", "alpha: 0.4"), ("main", "latency: 10s", "latency: 9s")):
        if branch == "theirs":
            git(shell.folder, "branch", "-M", "main")
            git(shell.folder, "checkout", "-q", "-b", "theirs")
        else:
            git(shell.folder, "checkout", "-q", "main")
        change(shell, old, new)
        shell("compile")
        commit(shell, branch)
    return shell


def run(shell: Shell, *words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(["git", *words], cwd=shell.folder, capture_output=True, text=True)


def test_a_merge_compiles_what_both_branches_compiled(branches: Shell) -> None:
    ended = run(branches, "merge", "-m", "merged", "theirs")
    assert ended.returncode == 0, ended
    assert "compiled/demo/manifest.yaml: compiled from what is merged" in ended.stderr
    assert "alpha: 0.4" in branches.read("compiled/demo/manifest.yaml")
    assert "limit: 9s" in branches.read("compiled/demo/manifest.yaml")
    branches("ci")
    branches("compile", "--check")


def test_a_rebase_does_the_same(branches: Shell) -> None:
    git(branches.folder, "checkout", "-q", "theirs")
    change(branches, "budget: $5", "budget: $6")
    branches("compile")
    commit(branches, "a second commit")
    ended = run(branches, "rebase", "main")
    assert ended.returncode == 0, ended
    branches("ci")


def test_a_project_in_a_subfolder(branches: Shell) -> None:
    for branch in ("theirs", "main"):
        git(branches.folder, "checkout", "-q", branch)
        (branches.folder / "robots").mkdir()
        for name in ("specs", "compiled", "results", "fogspec.lock", "offers.csv"):
            git(branches.folder, "mv", name, f"robots/{name}")
        branches.write(".gitattributes", "**/compiled/** merge=fogspec\n")
        commit(branches, "moved")
    ended = run(branches, "merge", "-m", "merged", "theirs")
    assert ended.returncode == 0, ended
    Shell(branches.folder / "robots", branches.monkeypatch, branches.capsys)("ci")


@pytest.mark.parametrize("how", ["merge", "cherry-pick"])
def test_where_it_cannot_be_compiled_git_reports_a_conflict(branches: Shell, how: str) -> None:
    git(branches.folder, "checkout", "-q", "theirs")
    if how == "merge":
        change(branches, "latency: 10s", "latency: 8s")
        branches("compile")
        commit(branches, "the same line")
    git(branches.folder, "checkout", "-q", "main")
    before = branches.read("compiled/demo/manifest.yaml")
    ended = run(branches, how, "theirs")
    assert ended.returncode == 1
    assert "compiled/demo/manifest.yaml: cannot be compiled in this merge" in ended.stderr
    assert "then: fogspec compile, git add compiled/demo/manifest.yaml" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert branches.read("compiled/demo/manifest.yaml") == before, "our side, without markers"
    text = branches.read("specs/demo.yaml")
    if how == "merge":
        assert "FS117" in branches("validate", code=1).err
        run(branches, "checkout", "--theirs", "specs/demo.yaml")
        change(branches, "alpha: 0.4", "alpha: 0.3")
    assert text
    branches("compile")
    commit(branches, "resolved")
    branches("ci")


def test_calls_by_hand_are_refused_in_words(branches: Shell) -> None:
    branches.write("ours", "x")
    for path in (
        "compiled/demo/manifest.yaml",
        "specs/demo.yaml",
        "../compiled/x",
        "compiled/nowhere/plan.yaml",
        "compiled/",
    ):
        ended = branches("merge-driver", "ours", path, code=3)
        assert "cannot be compiled in this merge" in ended.err
        assert branches.read("ours") == "x"
