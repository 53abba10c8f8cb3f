"""What is opened, written and removed in a project stays in the project, and what is written is on disk."""

import os
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from fogspec.base.errors import InvalidInput
from fogspec.base.project_files import LinkedPath, ProjectFiles, write_output

Act = Callable[[ProjectFiles, Path], object]
ON_FILES: dict[str, Act] = {
    "read": lambda files, path: files.read(path, 1),
    "open": lambda files, path: files.open(path).close(),
    "append": lambda files, path: files.append(path).close(),
    "create": lambda files, path: files.create(path).close(),
    "write": lambda files, path: files.write(path, b"new"),
    "move": lambda files, path: files.move(path, files.root / "other"),
    "move over it": lambda files, path: files.move(files.root / "given", path),
    "set aside": lambda files, path: files.set_aside(path, files.root / "other"),
    "set aside over it": lambda files, path: files.set_aside(files.root / "given", path),
    "remove": lambda files, path: files.remove(path),
    "stat": lambda files, path: files.stat(path),
}
ON_FOLDERS: dict[str, Act] = {
    "names": lambda files, path: files.names(path),
    "files": lambda files, path: list(files.files(path)),
    "remove_tree": lambda files, path: files.remove_tree(path),
}
DEEP: dict[str, Act] = {
    **ON_FILES,
    **ON_FOLDERS,
    "make_folder": lambda files, path: files.make_folder(path),
    "remove_folder": lambda files, path: files.remove_folder(path),
}


def canary(folder: Path) -> Path:
    outside = folder / "outside"
    (outside / "below").mkdir(parents=True)
    (outside / "file").write_bytes(b"precious")
    (outside / "below" / "file").write_bytes(b"precious")
    return outside


def fingerprint(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {
        str(path.relative_to(folder)): (path.read_bytes() if path.is_file() else b"", path.stat().st_mtime_ns)
        for path in [folder, *sorted(folder.rglob("*"))]
    }


def project(folder: Path) -> ProjectFiles:
    root = folder / "project"
    root.mkdir()
    (root / "given").write_bytes(b"given")
    return ProjectFiles(root)


@pytest.mark.parametrize("act", ON_FILES)
def test_a_link_at_a_file_is_not_followed(tmp_path: Path, act: str) -> None:
    outside, files = canary(tmp_path), project(tmp_path)
    before = fingerprint(outside)
    (files.root / "it").symlink_to(outside / "file")
    with pytest.raises(LinkedPath, match="it is a link"):
        ON_FILES[act](files, files.root / "it")
    assert fingerprint(outside) == before


@pytest.mark.parametrize("act", ON_FOLDERS)
def test_a_link_at_a_folder_is_not_followed(tmp_path: Path, act: str) -> None:
    outside, files = canary(tmp_path), project(tmp_path)
    before = fingerprint(outside)
    (files.root / "it").symlink_to(outside)
    with pytest.raises(LinkedPath, match="it is a link"):
        ON_FOLDERS[act](files, files.root / "it")
    assert fingerprint(outside) == before


@pytest.mark.parametrize("act", DEEP)
@pytest.mark.parametrize("where", ["first", "second"])
def test_a_link_on_the_way_is_not_followed(tmp_path: Path, act: str, where: str) -> None:
    outside, files = canary(tmp_path), project(tmp_path)
    before = fingerprint(outside)
    if where == "first":
        (files.root / "it").symlink_to(outside)
    else:
        (files.root / "it").mkdir()
        (files.root / "it" / "below").symlink_to(outside / "below")
    with pytest.raises(LinkedPath, match="it is a link"):
        DEEP[act](files, files.root / "it" / "below" / "file")
    assert fingerprint(outside) == before


@pytest.mark.parametrize("act", ON_FILES)
def test_a_link_that_leads_nowhere_is_a_link(tmp_path: Path, act: str) -> None:
    files = project(tmp_path)
    (files.root / "it").symlink_to(tmp_path / "made")
    with pytest.raises(LinkedPath, match="it is a link"):
        ON_FILES[act](files, files.root / "it")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("act", ["read", "append", "create"])
def test_a_link_that_appears_after_the_look_is_not_followed(
    tmp_path: Path, act: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel refuses it: the look alone, which says it nicely, may be too early."""
    outside, files = canary(tmp_path), project(tmp_path)
    before = fingerprint(outside)
    (files.root / "it").symlink_to(outside / "file")
    monkeypatch.setattr("fogspec.base.project_files._kind", lambda *_: None)
    with pytest.raises(OSError, match=r"[Ll]inks?"):
        ON_FILES[act](files, files.root / "it")
    (files.root / "folder").symlink_to(outside)
    with pytest.raises(OSError, match="Not a directory"):
        ON_FILES[act](files, files.root / "folder" / "file")
    assert fingerprint(outside) == before


@pytest.mark.parametrize("act", DEEP)
@pytest.mark.parametrize("path", ["../outside/file", "below/../../outside/file", "/etc/passwd", ".."])
def test_a_path_out_of_the_project_is_refused(tmp_path: Path, act: str, path: str) -> None:
    outside, files = canary(tmp_path), project(tmp_path)
    before = fingerprint(outside)
    with pytest.raises(InvalidInput, match="outside of the project"):
        DEEP[act](files, files.root / path)
    assert fingerprint(outside) == before


def test_the_project_itself_may_be_behind_a_link(tmp_path: Path) -> None:
    files = project(tmp_path)
    (tmp_path / "short").symlink_to(files.root)
    linked = ProjectFiles(tmp_path / "short")
    linked.write(linked.root / "a" / "b", b"content")
    assert (files.root / "a" / "b").read_bytes() == b"content"


def test_removing_a_tree_removes_links_in_it_and_not_what_they_lead_to(tmp_path: Path) -> None:
    outside, files = canary(tmp_path), project(tmp_path)
    before = fingerprint(outside)
    (files.root / "tree").mkdir()
    (files.root / "tree" / "folder").symlink_to(outside)
    (files.root / "tree" / "file").symlink_to(outside / "file")
    assert list(files.files(files.root / "tree")) == []
    assert files.remove_tree(files.root / "tree")
    assert not (files.root / "tree").exists()
    assert fingerprint(outside) == before


@pytest.mark.parametrize("act", ["read", "open", "append", "create"])
def test_a_pipe_is_refused_at_once(tmp_path: Path, act: str) -> None:
    files = project(tmp_path)
    os.mkfifo(files.root / "it")
    with pytest.raises(OSError, match="it is a pipe"):
        ON_FILES[act](files, files.root / "it")
    with pytest.raises(InvalidInput, match="cannot be written: it is a pipe"):
        files.write(files.root / "it", b"")


@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_modes_are_the_users(tmp_path: Path, mask: int) -> None:
    files, before = project(tmp_path), os.umask(mask)
    try:
        files.write(files.root / "it", b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE((files.root / "it").stat().st_mode) == 0o666 & ~mask


class Recorder:
    """The order of writes, syncs and renames, by what each was done to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.steps: list[str] = []
        sync, replace = os.fsync, os.replace

        def fsync(descriptor: int) -> None:
            mode = os.fstat(descriptor).st_mode
            content = "" if stat.S_ISDIR(mode) else f" of {os.fstat(descriptor).st_size} bytes"
            self.steps.append(("folder" if stat.S_ISDIR(mode) else "file") + content)
            sync(descriptor)

        def renamed(*words: object, **options: object) -> None:
            self.steps.append("renamed")
            replace(*words, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(os, "replace", renamed)


def test_a_written_file_is_synced_before_it_has_its_name_and_its_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = project(tmp_path)
    recorder = Recorder(monkeypatch)
    files.write(files.root / "it", b"12345")
    assert recorder.steps == ["file of 5 bytes", "renamed", "folder"]
    recorder.steps.clear()
    files.write(files.root / "new" / "it", b"12345")
    assert recorder.steps == ["folder", "file of 5 bytes", "renamed", "folder"], "the new folder itself must last too"


def test_a_file_to_add_to_lasts_from_when_it_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = project(tmp_path)
    recorder = Recorder(monkeypatch)
    files.append(files.root / "new" / "it").close()
    assert recorder.steps == ["folder", "folder"], "of the new folder, and of the new file"


def test_a_moved_file_lasts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = project(tmp_path)
    recorder = Recorder(monkeypatch)
    files.move(files.root / "given", files.root / "moved")
    assert recorder.steps == ["folder"]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_write_that_fails_leaves_the_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    files = project(tmp_path)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, failing, full)
    with pytest.raises(InvalidInput, match="given: cannot be written: No space left"):
        files.write(files.root / "given", b"new")
    monkeypatch.undo()
    assert [(path.name, path.read_bytes()) for path in files.root.iterdir()] == [("given", b"given")]


def test_an_output_that_the_user_names_goes_where_its_folder_leads(tmp_path: Path) -> None:
    outside = canary(tmp_path)
    (tmp_path / "out").symlink_to(outside / "below")
    write_output(tmp_path / "out" / "new", b"report")
    assert (outside / "below" / "new").read_bytes() == b"report"
    (tmp_path / "report.html").symlink_to(outside / "file")
    with pytest.raises(LinkedPath):
        write_output(tmp_path / "report.html", b"report")
    assert (outside / "file").read_bytes() == b"precious"


def test_what_each_method_says_and_leaves(tmp_path: Path) -> None:
    files = ProjectFiles(tmp_path / "not" / "yet")
    with files.create(files.root / "a/b/one") as file:
        file.write(b"a long text")
    with files.create(files.root / "a/b/one") as file:
        file.write(b"new")
    assert (files.root / "a/b/one").read_bytes() == b"new", "nothing of the old is left after it"
    files.make_folder(files.root / "c/d")
    with pytest.raises(FileExistsError):
        files.make_folder(files.root / "c/d")
    assert files.names(files.root) == ["a", "c"]
    assert (files.names(files.root / "absent"), files.names(files.root / "a/b/one")) == ([], [])
    assert list(files.files(files.root)) == [files.root / "a/b/one"]
    kinds = [(files.exists(path), files.is_file(path), files.is_folder(path)) for path in
             (files.root / "a/b/one", files.root / "a", files.root / "absent", files.root / "a/b/one/below")]  # fmt: skip
    assert kinds == [(True, True, False), (True, False, True), (False, False, False), (False, False, False)]
    assert files.remove_folder(files.root / "a") is False, "it is not empty"
    assert files.remove_folder(files.root / "c/d") is True
    assert files.remove_folder(files.root / "absent") is True
    assert files.remove(files.root / "a/b/one") is True
    assert files.remove(files.root / "a/b/one") is False
    assert files.remove_tree(files.root / "a") is True
    assert files.remove_tree(files.root / "a") is False
    assert sorted(os.listdir(files.root)) == ["c"]
    for act in (files.remove_tree, files.remove, files.make_folder):
        with pytest.raises(InvalidInput, match="the project's folder itself"):
            act(files.root)
    with files.append(files.root / "e/log") as log:
        log.write(b"1")
    with files.append(files.root / "e/log") as log:
        log.seek(0)
        assert log.read() == b"1"
        log.write(b"2")
    assert files.head(files.root / "e/log", 1) == b"1"
    assert files.read(files.root / "e/log", 2) == b"12"
    with pytest.raises(OSError, match="it has more than"):
        files.read(files.root / "e/log", 1)
    files.move(files.root / "e/log", files.root / "f/g/log")
    assert (files.root / "f/g/log").read_bytes() == b"12"


def test_a_write_never_goes_into_a_file_that_is_there_by_the_temporary_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = project(tmp_path)
    monkeypatch.setattr(os, "urandom", lambda count: b"\0" * count)
    planted = files.root / f".one.{'00' * 6}"
    planted.write_bytes(b"another's")
    with pytest.raises(InvalidInput, match="File exists"):
        files.write(files.root / "one", b"new")
    assert planted.read_bytes() == b"another's"


def test_a_tree_of_any_depth_and_with_any_permissions_is_removed(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """A node that makes folders in folders, or forbids to list them, does not keep `down` from removing what it wrote."""
    files, here = ProjectFiles(tmp_path), os.getcwd()
    # pytest itself cannot remove such a tree.
    request.addfinalizer(lambda: subprocess.run(["rm", "-rf", tmp_path / "d"], check=False))
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept").touch()
    os.chdir(tmp_path)
    try:
        for depth in range(3000):
            os.mkdir("d")
            if depth in (1000, 2000):
                os.symlink(outside, "d/link")
                os.mkdir("d/closed")
                Path("d/closed/file").touch()
                os.chmod("d/closed", 0)
            os.chdir("d")
    finally:
        os.chdir(here)
    assert list(files.files(tmp_path / "d")) == []
    assert files.remove_tree(tmp_path / "d")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["outside"]
    assert (outside / "kept").exists()


def test_no_handle_is_left_open(tmp_path: Path) -> None:
    files, before = ProjectFiles(tmp_path), len(os.listdir("/proc/self/fd"))
    files.write(tmp_path / "a/b/c/file", b"")
    (tmp_path / "a/b/link").symlink_to(tmp_path)
    for _ in range(5):
        files.read(tmp_path / "a/b/c/file", 99)
        with pytest.raises(LinkedPath):
            files.read(tmp_path / "a/b/link/file", 99)
        with pytest.raises(FileNotFoundError):
            files.read(tmp_path / "a/b/missing/file", 99)
    assert len(os.listdir("/proc/self/fd")) == before


def test_the_component_that_is_a_link_is_the_one_that_is_named(tmp_path: Path) -> None:
    files = ProjectFiles(tmp_path)
    files.write(tmp_path / "a/b/file", b"")
    (tmp_path / "a/link").symlink_to(tmp_path / "a/b")
    with pytest.raises(LinkedPath, match=rf"^{tmp_path}/a/link: it is a link"):
        files.read(tmp_path / "a/link/c/file", 99)


def test_what_is_set_aside_stays_until_it_is_written_over(tmp_path: Path) -> None:
    files = project(tmp_path)
    files.set_aside(files.root / "given", files.root / "new/kept")
    assert (files.root / "given").read_bytes() == b"given"
    files.write(files.root / "given", b"other")
    assert (files.root / "new/kept").read_bytes() == b"given"
    os.mkfifo(files.root / "pipe")
    files.set_aside(files.root / "pipe", files.root / "moved")
    assert sorted(path.name for path in files.root.iterdir()) == ["given", "moved", "new"], (
        "what cannot be written over moves"
    )


def test_git_ignores_the_folder_of_live_state(tmp_path: Path) -> None:
    files = project(tmp_path)
    files.write(files.root / ".fogspec/demo/deployment.yaml", b"live")
    assert (files.root / ".fogspec/.gitignore").read_bytes() == b"*\n"
    (files.root / ".fogspec/.gitignore").write_bytes(b"my own\n")
    files.append(files.root / ".fogspec/demo/log").close()
    assert (files.root / ".fogspec/.gitignore").read_bytes() == b"my own\n"
    files.remove_tree(files.root / ".fogspec/demo")
    assert files.remove_folder(files.root / ".fogspec")


def test_what_keeps_live_state_out_of_git_is_written_through_no_link(tmp_path: Path) -> None:
    files, outside = project(tmp_path), canary(tmp_path)
    before = fingerprint(outside)
    (files.root / ".fogspec").mkdir()
    (files.root / ".fogspec/.gitignore").symlink_to(outside / "new")
    files.write(files.root / ".fogspec/demo/deployment.yaml", b"live")
    assert fingerprint(outside) == before
