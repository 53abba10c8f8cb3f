"""Programs of ours are found by absolute paths, and start without the working folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fogspec.base import child

BIN = Path(sys.executable).parent


def marking(folder: Path, *modules: str) -> Path:
    """Modules that leave a mark when they are imported."""
    mark = folder / "mark"
    for name in modules:
        (folder / f"{name}.py").write_text(f"open({str(mark)!r}, 'a').close()\n")
    return mark


@pytest.mark.parametrize("path", [".", "", "relative", ".:", "::"])
def test_a_program_is_not_found_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    for folder in (tmp_path, tmp_path / "relative"):
        folder.mkdir(exist_ok=True)
        (folder / "tool").write_text("#!/bin/sh\n")
        (folder / "tool").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", path)
    with pytest.raises(FileNotFoundError, match="none of the absolute folders of PATH"):
        child.program("tool")
    monkeypatch.setenv("PATH", os.pathsep.join([path, str(tmp_path / "relative")]))
    assert child.program("tool") == str(tmp_path / "relative" / "tool")


def test_search_paths_of_children_are_absolute(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", ":.:/usr/bin:bin:/bin:")
    monkeypatch.setenv("PYTHONPATH", ".")
    monkeypatch.setenv("LD_LIBRARY_PATH", "/opt/lib:")
    found = child.environment(MORE="1")
    assert (found["PATH"], found["PYTHONPATH"]) == ("/usr/bin:/bin", "/")
    assert (found["LD_LIBRARY_PATH"], found["MORE"]) == ("/opt/lib", "1")


def test_an_interpreter_of_ours_imports_nothing_from_the_working_folder(tmp_path: Path) -> None:
    mark = marking(tmp_path, "sitecustomize", "usercustomize", "runpy", "queue", "json", "fogspec", "sky")
    ended = subprocess.run(
        child.python("fogspec.agent"), cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": ":.", "PYTHONSTARTUP": "queue.py"},
    )  # fmt: skip
    assert "arguments are required: PROGRAM" in ended.stderr, "it is our own one"
    assert not mark.exists()


@pytest.mark.parametrize("start", [[str(BIN / "fogspec")], [sys.executable, "-m", "fogspec"]])
def test_fogspec_itself_leaves_the_working_folder_before_it_imports(tmp_path: Path, start: list[str]) -> None:
    """Before that, Python has imported what it needs for `-m` itself: see docs/explanation/security.md."""
    mark = marking(tmp_path, "click", "rich", "json", "pydantic", "difflib", "ruamel")
    paths = [":", ""] if "-m" not in start else [""]
    for path in paths:
        environment = {**os.environ, "PYTHONPATH": path}
        ended = subprocess.run(
            [*start, "explain", "FS101"], cwd=tmp_path, capture_output=True, text=True, env=environment
        )
        assert ended.returncode == 0, ended.stderr
        assert not mark.exists()
