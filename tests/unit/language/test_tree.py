"""The tree that is sent: one list for digests and snapshots, checked with the system's own tools."""

import os
import shutil
import socket
import subprocess
from pathlib import Path

import pytest

from fogspec.base.errors import InvalidInput
from fogspec.language import tree as module
from fogspec.language.tree import Tree


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "specs"
    for name, text in (("work.py", "import helper\n"), ("lib/helper.py", "x = 1\n"), ("lib/deep/data.bin", "\0" * 10)):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (root / "run.sh").write_text("#!/bin/sh\n")
    (root / "run.sh").chmod(0o700)
    (root / "latest").symlink_to("lib/deep")
    return root


def found_by_the_system(folder: Path) -> dict[str, str]:
    """The same list by `find`, `sha256sum` and `readlink`."""
    listed = {}
    for path in sorted(subprocess.run(["find", ".", "(", "-type", "f", "-o", "-type", "l", ")"], cwd=folder, check=True,
                                      capture_output=True, text=True).stdout.split("\n")[:-1]):  # fmt: skip
        name = path.removeprefix("./")
        if (folder / name).is_symlink():
            goal = subprocess.run(["readlink", name], cwd=folder, check=True, capture_output=True, text=True).stdout
            listed[name] = f"link to {goal.rstrip()}"
        else:
            hashed = subprocess.run(["sha256sum", name], cwd=folder, check=True, capture_output=True, text=True).stdout
            mode = subprocess.run(["stat", "-c", "%A", name], cwd=folder, check=True, capture_output=True, text=True)
            listed[name] = f"{'executable ' if mode.stdout[3] == 'x' else ''}sha256:{hashed.split()[0]}"
    return listed


def test_what_is_digested_is_what_is_copied(folder: Path, tmp_path: Path) -> None:
    tree = Tree(folder, ())
    digests = tree.digests()
    assert digests == found_by_the_system(folder)
    assert list(digests) == sorted(digests)
    copy = tmp_path / "copy"
    copy.mkdir()
    assert tree.snapshot(copy) == digests
    (copy / ".skyignore").unlink()
    assert found_by_the_system(copy) == digests
    assert (copy / "run.sh").stat().st_mode & 0o7777 == 0o755
    assert (copy / "work.py").stat().st_mode & 0o7777 == 0o644


def test_a_snapshot_is_no_link_to_what_it_was_made_of(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    Tree(folder, ()).snapshot(tmp_path / "copy")
    (folder / "work.py").write_text("changed")
    assert (tmp_path / "copy/work.py").read_text() == "import helper\n"
    with pytest.raises(InvalidInput, match="File exists"):
        Tree(folder, ()).snapshot(tmp_path / "copy")


def test_times_owners_and_empty_directories_do_not_count(folder: Path) -> None:
    before = Tree(folder, ()).digests()
    os.utime(folder / "work.py", (1, 1))
    (folder / "work.py").chmod(0o640)
    (folder / "empty").mkdir()
    assert Tree(folder, ()).digests() == before


@pytest.mark.parametrize(
    ("pattern", "gone"),
    [
        ("lib", {"lib/helper.py", "lib/deep/data.bin"}),
        ("lib/", {"lib/helper.py", "lib/deep/data.bin"}),
        ("deep", {"lib/deep/data.bin"}),
        ("/deep", set()),
        ("lib/deep", {"lib/deep/data.bin"}),
        ("*.py", {"work.py", "lib/helper.py"}),
        ("/*.py", {"work.py"}),
        ("lib/*.py", {"lib/helper.py"}),
        ("LIB", set()),
        ("latest", {"latest"}),
        ("[rw]*", {"run.sh", "work.py"}),
    ],
)
def test_patterns(folder: Path, tmp_path: Path, pattern: str, gone: set[str]) -> None:
    tree, every = Tree(folder, (pattern,)), set(Tree(folder, ()).digests())
    if pattern == "/*.py":
        gone = gone | {"lib/helper.py"}  # an asterisk is any text, slashes too
    assert every - set(tree.digests()) == gone
    assert {path for path in every if tree.excludes(path)} == gone
    (tmp_path / "copy").mkdir()
    tree.snapshot(tmp_path / "copy")
    assert every - set(found_by_the_system(tmp_path / "copy")) == gone


def test_specs_are_no_files_of_a_workload_but_other_yaml_is(folder: Path) -> None:
    (folder / "demo.yaml").write_text("# mine\napiVersion: fogspec.dev/v1alpha1\nkind: Application\n")
    (folder / "quoted.yml").write_text('---\napiVersion: "fogspec.dev/v1alpha1"\n')
    (folder / "parameters.yaml").write_text("node: {apiVersion: fogspec.dev/v1alpha1}\n")
    (folder / "demo.txt").write_text("apiVersion: fogspec.dev/v1alpha1\n")
    (folder / "lib/demo.yaml").write_text("apiVersion: fogspec.dev/v1alpha1\n")
    assert set(Tree(folder, ()).digests()) >= {"parameters.yaml", "demo.txt", "lib/demo.yaml"}
    assert not set(Tree(folder, ()).digests()) & {"demo.yaml", "quoted.yml"}


@pytest.mark.parametrize("goal", ["/etc/passwd", "..", "../other", "lib/../../other", "lib/up/other", "/proc"])
def test_a_link_that_leads_outside_is_refused_and_never_followed(folder: Path, tmp_path: Path, goal: str) -> None:
    (tmp_path / "other").write_text("not mine")
    (tmp_path / "copy").mkdir()
    (folder / "lib/up").symlink_to("../..")
    (folder / "away").symlink_to(goal)
    with pytest.raises(InvalidInput, match="leads outside"):
        Tree(folder, ("up",)).digests()
    with pytest.raises(InvalidInput, match="leads outside"):
        Tree(folder, ("up",)).snapshot(tmp_path / "copy")


def test_a_link_that_leads_out_and_in_again_is_refused_since_the_folder_has_another_name_on_a_machine(
    folder: Path,
) -> None:
    (folder / "back").symlink_to(f"../{folder.name}/work.py")
    with pytest.raises(InvalidInput, match="leads outside"):
        Tree(folder, ()).digests()


def test_a_hard_link_is_the_file_that_it_is(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "other").write_text("not mine")
    os.link(tmp_path / "other", folder / "other")
    assert Tree(folder, ()).digests() == found_by_the_system(folder)
    assert "other" in Tree(folder, ()).digests()


def test_a_directory_reached_by_a_link_is_still_inside(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(folder)
    assert Tree(tmp_path / "link", ()).digests() == Tree(folder, ()).digests()


def test_a_link_may_dangle_or_turn_in_a_circle(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    (folder / "later").symlink_to("made/on/the/machine")
    (folder / "circle").symlink_to("circle")
    found = Tree(folder, ()).snapshot(tmp_path / "copy")
    assert (found["later"], found["circle"]) == ("link to made/on/the/machine", "link to circle")


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_what_is_no_file_is_refused_and_not_waited_for(
    folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)  # a socket's path is short
    if kind == "pipe":
        os.mkfifo("thing")
    else:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind("thing")
    with pytest.raises(InvalidInput, match="thing: cannot be sent"):
        Tree(folder, ()).digests()
    assert "thing" not in Tree(folder, ("thing",)).digests()


@pytest.mark.parametrize("name", ["a\nb.py", "a\u202eyp.b", "a\x1b[2Jb", os.fsdecode(b"\xff.py")])
def test_names_that_no_line_can_show_are_refused(folder: Path, name: str) -> None:
    (folder / name).write_text("")
    with pytest.raises(InvalidInput, match="not printable") as refused:
        Tree(folder, ()).digests()
    assert refused.value.message.isprintable()
    (folder / name).unlink()
    (folder / "link").symlink_to(name)
    with pytest.raises(InvalidInput, match="not printable"):
        Tree(folder, ()).digests()


def test_limits_on_files_bytes_and_depth(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = Tree(folder, ())
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    monkeypatch.setattr(module, "MOST_BYTES", size)
    tree.digests()
    monkeypatch.setattr(module, "MOST_BYTES", size - 1)
    with pytest.raises(InvalidInput, match="GiB would be sent") as refused:
        tree.digests()
    assert "spec.files" in refused.value.hints[0]
    monkeypatch.undo()
    monkeypatch.setattr(module, "MOST_FILES", 5)
    tree.digests()
    monkeypatch.setattr(module, "MOST_FILES", 4)
    with pytest.raises(InvalidInput, match="more than 4 files"):
        tree.digests()
    monkeypatch.undo()
    deep = folder
    for _ in range(module.MOST_DEEP + 1):
        deep = deep / "d"
    deep.parent.mkdir(parents=True)
    tree.digests()
    deep.mkdir()
    with pytest.raises(InvalidInput, match="more than 64 directories deep"):
        tree.digests()


def test_a_hole_of_a_terabyte_is_not_read(folder: Path) -> None:
    with open(folder / "hole", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InvalidInput, match="more than 8 GiB") as refused:
        Tree(folder, ()).digests()
    assert "hole passes the limit" in refused.value.hints[0]


def test_a_file_that_cannot_be_read(folder: Path) -> None:
    if os.geteuid() == 0:
        shutil.rmtree(folder)
        with pytest.raises(InvalidInput, match="cannot be sent"):
            Tree(folder, ()).digests()
    else:
        (folder / "work.py").chmod(0)
        with pytest.raises(InvalidInput, match=r"work\.py: cannot be sent"):
            Tree(folder, ()).digests()


def test_a_whole_path_is_another_one_on_a_machine(folder: Path) -> None:
    (folder / "whole").symlink_to(folder / "work.py")
    with pytest.raises(InvalidInput, match="leads outside"):
        Tree(folder, ()).digests()
