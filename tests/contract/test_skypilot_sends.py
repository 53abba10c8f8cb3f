"""SkyPilot's own code sends a snapshot whole: nothing is left out of it by `.gitignore`, and nothing is added."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fogspec.spec.tree import Tree

SENT = """
import json, sys, zipfile
from sky.data import storage_utils
folder, archive = sys.argv[1:]
storage_utils.zip_files_and_folders([folder], archive, relative_to_items=True)
names = zipfile.ZipFile(archive).namelist()
print(json.dumps([storage_utils.get_excluded_files(folder), [one for one in names if not one.endswith("/")]]))
"""


def sent_of(folder: Path, archive: Path) -> tuple[list[str], set[str]]:
    words = [sys.executable, "-c", SENT, str(folder), str(archive)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr[-2000:]
    excluded, names = json.loads(ended.stdout.splitlines()[-1])
    return excluded, {name.partition("/")[2] for name in names}


@pytest.mark.slow
def test_a_snapshot_is_sent_whole(tmp_path: Path) -> None:
    pytest.importorskip("sky")
    project = tmp_path / "project"
    folder = project / "specs"
    (folder / "lib").mkdir(parents=True)
    for name, text in (
        ("work.py", "x"), ("lib/model.onnx", "weights"), (".gitignore", "*.onnx\n"), ("lib/.gitignore", "*\n"),
        (".env", "KEY=1"), ("lib/.skyignore", "*\n"),
    ):  # fmt: skip
        (folder / name).write_text(text)
    (folder / "latest").symlink_to("work.py")
    (project / ".gitignore").write_text(".fogspec/\n")
    subprocess.run(["git", "init", "-q", str(project)], check=True)
    snapshot = project / ".fogspec/demo/sent/one"
    snapshot.mkdir(parents=True)
    listed = Tree(folder, (".env", ".skyignore")).snapshot(snapshot)
    assert "lib/model.onnx" in listed
    excluded, names = sent_of(snapshot, tmp_path / "snapshot.zip")
    assert excluded == []
    assert names == {*listed, ".skyignore"}
    _, as_it_was = sent_of(folder, tmp_path / "folder.zip")
    assert "lib/model.onnx" not in as_it_was, "the folder itself would have been sent without it"
    assert ".env" in as_it_was, "and with what is nobody's"
