"""The repository of a directory, from git's own configuration."""

import os
import subprocess
from pathlib import Path

import pytest

from fogspec.base.repository import normalized, repository_of

HOST = os.uname().nodename


@pytest.mark.parametrize(
    "url",
    [
        "https://forge.test/lab/robots.git",
        "https://user:token@forge.test/lab/robots",
        "http://FORGE.test:80/lab/robots/",
        "git@forge.test:lab/robots.git",
        "forge.test:lab/robots",
        "ssh://git@forge.test/lab/robots.git",
        "ssh://git@forge.test:22//lab/robots.git/",
        "git://forge.test/lab/robots.git",
    ],
)
def test_one_origin_is_the_same_by_any_protocol(url: str) -> None:
    assert normalized(url, Path("/")) == "forge.test/lab/robots"


def test_other_origins_are_not_the_same() -> None:
    urls = ("git@forge.test:fork/robots", "git@forge.test:lab/Robots", "ssh://forge.test:2222/lab/robots",
            "git@other.test:lab/robots", "git@forge.test:robots", "/forge.test/lab/robots", "")  # fmt: skip
    found = [normalized(url, Path("/")) for url in urls]
    assert len({*found, "forge.test/lab/robots"}) == len(urls) + 1
    assert normalized("git@github.com:Lab/Robots.git", Path("/")) == "github.com/lab/robots"


def git(folder: Path, *words: str) -> None:
    subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    folder = tmp_path / "clone"
    folder.mkdir()
    git(folder, "init", "-q")
    git(folder, "remote", "add", "origin", "git@forge.test:lab/robots.git")
    return folder


def test_a_directory_of_a_clone_has_its_place_in_the_origin(clone: Path) -> None:
    (clone / "arm" / "specs").mkdir(parents=True)
    assert repository_of(clone) == "forge.test/lab/robots"
    assert repository_of(clone / "arm") == "forge.test/lab/robots//arm"
    (clone.parent / "link").symlink_to(clone / "arm")
    assert repository_of(clone.parent / "link") == "forge.test/lab/robots//arm"


def test_a_worktree_has_the_origin_of_its_clone(clone: Path) -> None:
    git(clone, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "--allow-empty", "-m", "first")
    git(clone, "worktree", "add", "-q", "../tree")
    assert repository_of(clone.parent / "tree") == "forge.test/lab/robots"


def test_without_an_origin_it_is_this_place(tmp_path: Path, clone: Path) -> None:
    assert repository_of(tmp_path) == f"file://{HOST}{os.path.realpath(tmp_path)}"
    git(clone, "remote", "rename", "origin", "upstream")
    assert repository_of(clone) == f"file://{HOST}{os.path.realpath(clone)}"
    git(clone, "remote", "add", "origin", "../bare.git")
    assert repository_of(clone) == f"file://{HOST}{os.path.realpath(tmp_path)}/bare"


def test_git_reads_its_configuration_alike(clone: Path) -> None:
    """Quotes, comments, escapes, continued lines and case; what a committed file says does not count."""
    (clone / ".gitconfig").write_text('[remote "origin"]\n\turl = https://evil.test/a\n')
    (clone / ".git" / "config").write_text(
        '[Remote "origin"] URL = https://old.test/a # before\n[remote "ORIGIN"]\nurl = https://evil.test/b\n'
        '[remote "origin"]\n\tpushurl = https://evil.test/c\n; url = https://evil.test/d\n'
        '\turl = "https://forge.test/lab/#1" ; a comment\n[remote "origin.x"]\nurl = https://evil.test/e\n'
        '[remote "origin"]\n\tfetch = +refs/heads/*:\\\nrefs/remotes/origin/*\n'
    )
    said = subprocess.run(["git", "config", "--get", "remote.origin.url"], cwd=clone, check=True, capture_output=True)
    assert repository_of(clone) == normalized(said.stdout.decode(), clone) == "forge.test/lab/#1"


@pytest.mark.parametrize("content", [b"", b"\xff[remote", b'[remote "origin"]\nurl =\n', b'[remote "origin"]\nurl\n'])
def test_a_damaged_configuration_has_no_origin(clone: Path, content: bytes) -> None:
    (clone / ".git" / "config").write_bytes(content)
    assert repository_of(clone) == f"file://{HOST}{os.path.realpath(clone)}"
