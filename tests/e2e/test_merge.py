"""Git's merges of branches that were compiled, with the `.gitattributes` that `init` writes."""

import shutil
import subprocess

import pytest

from tests.e2e.test_diff import change, commit, git, repository  # noqa: F401
from tests.support.running import Shell, shell  # noqa: F401


@pytest.fixture
def branches(repository: Shell) -> Shell:
    """Two branches that change one spec in different lines, each compiled; `main` is checked out."""
    shell = repository
    # The lines are apart, so that git merges the spec.
    shell.write("specs/demo.yaml", shell.read("specs/demo.yaml").replace("  ", "\n\n\n  "))
    shell("init", "other")
    shutil.rmtree(shell.folder / "specs/other")
    shell("compile")
    commit(shell, "apart")
    git(shell.folder, "branch", "-M", "main")
    git(shell.folder, "branch", "theirs")
    for branch, old, new in (("theirs", "alpha: 0.5", "alpha: 0.4"), ("main", "latency: 10s", "latency: 9s")):
        git(shell.folder, "checkout", "-q", branch)
        change(shell, old, new)
        shell("compile")
        commit(shell, branch)
    return shell


@pytest.mark.parametrize("how", ["merge", "rebase"])
def test_git_keeps_one_side_whole_and_compile_makes_the_rest(branches: Shell, how: str) -> None:
    with pytest.raises(subprocess.CalledProcessError) as stopped:
        git(branches.folder, how, "theirs")
    assert "CONFLICT (content): Merge conflict in compiled/demo/manifest.yaml" in stopped.value.stdout
    assert "specs/demo.yaml" not in git(branches.folder, "diff", "--name-only", "--diff-filter=U")
    manifest = branches.read("compiled/demo/manifest.yaml")
    assert ("alpha: 0.5" in manifest) == (how == "merge"), "HEAD's side, without markers"
    assert "<<<<" not in manifest
    branches("check", code=3)
    branches("compile")
    assert "alpha: 0.4" in branches.read("compiled/demo/manifest.yaml")
    assert "limit: 9s" in branches.read("compiled/demo/manifest.yaml")
    git(branches.folder, "add", "-A")
    git(branches.folder, "-c", "core.editor=true", how, "--continue")
    branches("check")


def test_a_spec_that_conflicts_is_reported_at_its_markers(branches: Shell) -> None:
    git(branches.folder, "checkout", "-q", "theirs")
    change(branches, "latency: 10s", "latency: 8s")
    commit(branches, "the same line")
    git(branches.folder, "checkout", "-q", "main")
    with pytest.raises(subprocess.CalledProcessError):
        git(branches.folder, "merge", "theirs")
    assert "FS117" in branches("validate", code=1).err
