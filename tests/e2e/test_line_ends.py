"""A project in order, cloned where git writes CRLF: what is said, what mends it, and what prevents it."""

import subprocess
from dataclasses import replace

import pytest

from tests.e2e.test_diff import commit, git, repository  # noqa: F401
from tests.support.running import Shell, shell  # noqa: F401

SAYS = "its line ends differ from those of the plan, and nothing else: git's core.autocrlf"
MEND = r"git config core.autocrlf input && sed -i 's/\r$//' specs/work.py"


def cloned(shell: Shell) -> Shell:
    """A clone of a user with core.autocrlf=true."""
    folder = shell.folder.with_name("clone")
    git(shell.folder, "clone", "-q", "-c", "core.autocrlf=true", ".", str(folder))
    return replace(shell, folder=folder)


@pytest.mark.parametrize(
    "words",
    [
        ("status", "demo"), ("compile", "demo"), ("bench", "demo", "--dry-run"), ("menu", "demo"), ("check", "demo"),
        ("explain", "demo"), ("report", "demo"), ("diff", "demo"), ("apply", "compiled/demo/manifest.yaml", "--dry-run"),
    ],
)  # fmt: skip
def test_each_verb_says_that_only_the_line_ends_differ_and_what_mends_them(
    repository: Shell, words: tuple[str, ...]
) -> None:
    clone = cloned(repository)
    assert b"\r\n" in (clone.folder / "specs/work.py").read_bytes()
    found = clone(*words, code=None)
    assert found.code == {"check": 3}.get(words[0], 1)
    said = found.out + found.err
    assert SAYS in said
    assert MEND in said
    assert "bench" not in said, "no advice to measure again"


def test_what_is_advised_mends_it_and_nothing_is_measured_again(repository: Shell) -> None:
    clone = cloned(repository)
    subprocess.run(MEND, shell=True, check=True, cwd=clone.folder)
    found = clone("status", "demo", code=None).out
    assert "results   fresh" in found
    assert "its line ends differ, and nothing else: git's core.autocrlf" in found
    clone("compile", "demo")
    assert git(clone.folder, "diff", "HEAD") == ""
    git(clone.folder, "add", "-A")
    clone("check", "demo")


def test_a_file_whose_mode_changed_has_its_line_ends(repository: Shell) -> None:
    (repository.folder / "specs/work.py").chmod(0o755)
    found = repository("status", "demo", code=None)
    assert SAYS not in found.out + found.err
    assert "work.py changed" in found.out


def test_a_file_that_was_also_edited_is_another(repository: Shell) -> None:
    clone = cloned(repository)
    path = clone.folder / "specs/work.py"
    path.write_bytes(path.read_bytes() + b"print('more')\r\n")
    found = clone("status", "demo", code=None)
    assert SAYS not in found.out + found.err
    assert "work.py changed" in found.out


def test_what_init_tells_git_keeps_line_ends(repository: Shell) -> None:
    repository("init", "other")
    git(repository.folder, "rm", "-q", "-r", "--cached", ".")
    commit(repository, "attributes")
    clone = cloned(repository)
    assert b"\r\n" not in (clone.folder / "specs/work.py").read_bytes()
    clone("check", "demo")
