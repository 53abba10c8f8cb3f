"""Git reads a checkout that others wrote, and runs nothing that it names."""

import contextlib
import os
import subprocess
from pathlib import Path

import pytest

from fogspec.base.errors import UsageError
from fogspec.base.git import OVERRIDES, exchange, git

READING = (
    ("rev-parse", "--show-toplevel"),
    ("ls-files", "-z", "--", "file"),
    ("ls-tree", "-r", "-z", "--name-only", "HEAD"),
    ("cat-file", "blob", "HEAD:file"),
    ("merge-base", "HEAD", "HEAD"),
)
NAMING = ("core.fsmonitor", "core.pager", "core.sshCommand", "core.askPass", "credential.helper", "diff.external",
          "gpg.program", "diff.evil.textconv", "diff.evil.command", "filter.evil.smudge", "filter.evil.process",
          "pager.ls-files", "pager.cat-file", "uploadpack.packObjectsHook", "trace2.eventTarget")  # fmt: skip


def plain(folder: Path, *words: str) -> None:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


def program(folder: Path) -> tuple[Path, Path]:
    path, mark = folder / "evil", folder / "mark"
    path.write_text(f"#!/bin/sh\n: >> '{mark}'\n")
    path.chmod(0o755)
    return path, mark


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    folder = tmp_path / "checkout"
    folder.mkdir()
    plain(folder, "init", "-q")
    (folder / "file").write_text("content\n")
    (folder / ".gitattributes").write_text("* diff=evil filter=evil\n")
    plain(folder, "add", "-A")
    plain(folder, "commit", "-q", "-m", "all")
    return folder


def test_it_reads(checkout: Path) -> None:
    assert git("cat-file", "blob", "HEAD:file", folder=checkout) == b"content\n"
    assert git("ls-files", "-z", "--", "file", folder=checkout) == b"file\0"
    with pytest.raises(UsageError, match="git rev-parse"):
        git("rev-parse", "--verify", "nothing", folder=checkout)


def test_what_it_prints_has_an_end(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fogspec.base.git.LONGEST_OUTPUT", 8)
    assert git("cat-file", "blob", "HEAD:file", folder=checkout) == b"content\n"
    (checkout / "file").write_bytes(b"x" * (1 << 20))
    plain(checkout, "commit", "-qam", "more")
    with pytest.raises(UsageError, match="git cat-file: it prints more than"):
        git("cat-file", "blob", "HEAD:file", folder=checkout)


def test_a_git_that_does_not_end_is_ended(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fogspec.base.git.GIT_S", 0.05)
    # It reads from standard input what is never written.
    monkeypatch.setattr("fogspec.base.git.subprocess.DEVNULL", subprocess.PIPE)
    with pytest.raises(UsageError, match="git cat-file: it has not ended within"):
        git("cat-file", "--batch", folder=checkout)


def test_it_runs_no_program_that_the_configuration_names(checkout: Path, tmp_path: Path) -> None:
    evil, mark = program(tmp_path)
    for name in NAMING:
        plain(checkout, "config", name, str(evil))
    for hook in ("post-index-change", "post-checkout", "reference-transaction"):
        (checkout / ".git" / "hooks" / hook).write_bytes(evil.read_bytes())
        (checkout / ".git" / "hooks" / hook).chmod(0o755)
    os.utime(checkout / "file", (1, 1))  # so that the index is not fresh
    mark.unlink(missing_ok=True)
    for words in READING:
        git(*words, folder=checkout)
    assert not mark.exists()
    subprocess.run(["git", "status"], cwd=checkout, capture_output=True)
    assert mark.exists(), "the trap works"


@pytest.mark.parametrize("kind", ["clean", "process"])
def test_a_filter_runs_only_if_the_user_has_it_too(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """As `git lfs install` does, for every repository or for one."""
    evil, mark = program(tmp_path)
    for name in (f"filter.evil.{kind}", f"filter.a=b.{kind}", "filter.evil.required"):
        plain(checkout, "config", name, "true" if name.endswith("required") else str(evil))
    (checkout / "other").write_text("content\n")
    (checkout / ".gitattributes").write_text("* filter=evil\nother filter=a=b\n")
    os.utime(checkout / "file", (1, 1))
    assert git("diff", "--name-only", "HEAD", "--", "file", folder=checkout) == b""
    assert not mark.exists()
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", str(tmp_path / "global"))
    subprocess.run(["git", "config", "--global", f"filter.evil.{kind}", str(evil)], check=True)
    subprocess.run(["git", "config", "--global", "filter.evil.required", "true"], check=True)
    os.utime(checkout / "file", (2, 2))
    with contextlib.suppress(UsageError):  # this one answers nothing
        git("diff", "--name-only", "HEAD", "--", "file", folder=checkout)
    assert mark.exists()


def test_it_fetches_nothing_that_is_missing(checkout: Path, tmp_path: Path) -> None:
    """A partial clone asks its remote, whose address may be a command."""
    evil, mark = program(tmp_path)
    blob = git("rev-parse", "HEAD:file", folder=checkout).decode().strip()
    (checkout / ".git" / "objects" / blob[:2] / blob[2:]).unlink()
    for name, value in (("core.repositoryFormatVersion", "1"), ("extensions.partialClone", "origin"),
                        ("remote.origin.promisor", "true"), ("protocol.ext.allow", "always"),
                        ("remote.origin.url", f"ext::{evil}")):  # fmt: skip
        plain(checkout, "config", name, value)
    with pytest.raises(UsageError, match="git cat-file"):
        git("cat-file", "blob", blob, folder=checkout)
    assert not mark.exists()
    subprocess.run(["git", "cat-file", "blob", blob], cwd=checkout, capture_output=True)
    assert mark.exists(), "the trap works"


def test_a_folder_that_looks_like_a_repository_is_none(checkout: Path, tmp_path: Path) -> None:
    """Its configuration would be a file that anybody can commit."""
    evil, mark = program(tmp_path)
    bare = checkout / "specs"
    plain(tmp_path, "clone", "-q", "--bare", str(checkout), str(bare))
    plain(bare, "config", "core.worktree", str(checkout))
    plain(bare, "config", "core.bare", "false")
    plain(bare, "config", "core.fsmonitor", str(evil))
    with pytest.raises(UsageError, match="bare"):
        git("ls-files", folder=bare)
    assert not mark.exists()


def test_every_override_is_given(checkout: Path) -> None:
    said = git("config", "--show-scope", "--list", folder=checkout).decode()
    for name, value in OVERRIDES.items():
        assert f"command\t{name.lower()}={value}" in said.lower()


def test_an_exchange_has_the_headers_after_what_the_user_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("COUNT", "1"), ("KEY_0", "user.name"), ("VALUE_0", "theirs")):
        monkeypatch.setenv(f"GIT_CONFIG_{name}", value)
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "another"))
    folder = tmp_path / "own"
    folder.mkdir()
    assert exchange("init", "--bare", "--quiet", "--template=", folder=folder).code == 0
    assert not (tmp_path / "another").exists()
    headers = {"http.https://forge.test/.extraheader": "AUTHORIZATION: basic abc"}
    asked = ("config", "--get-urlmatch", "http.extraheader", "https://forge.test/lab/robots.git")
    assert exchange(*asked, folder=folder, headers=headers).output == b"AUTHORIZATION: basic abc\n"
    assert exchange("config", "user.name", folder=folder, headers=headers).output == b"theirs\n"
    assert exchange(*asked, folder=folder).code == 1


def test_an_exchange_runs_no_command_that_a_url_names(tmp_path: Path) -> None:
    exchange("init", "--bare", "--quiet", "--template=", folder=tmp_path)
    for url in (f"ext::touch {tmp_path}/mark", f"--upload-pack=touch {tmp_path}/mark", "fd::0"):
        assert exchange("ls-remote", "--", url, folder=tmp_path).code
    assert not (tmp_path / "mark").exists()
