"""SkyPilot's own code sends a snapshot whole: nothing is left out of it by `.gitignore`, and nothing is added."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from fogspec.language.tree import Tree

SENT = """
import json, sys, zipfile
from sky.data import storage_utils
archive, *folders = sys.argv[1:]
for folder in folders:
    storage_utils.zip_files_and_folders([folder], archive, relative_to_items=True)
    names = zipfile.ZipFile(archive).namelist()
    print(json.dumps([storage_utils.get_excluded_files(folder), [one for one in names if not one.endswith("/")]]))
"""


def sent_of(archive: Path, *folders: Path) -> list[tuple[list[str], set[str]]]:
    words = [sys.executable, "-c", SENT, str(archive), *map(str, folders)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr[-2000:]
    said = map(json.loads, ended.stdout.splitlines()[-len(folders) :])
    return [(excluded, {name.partition("/")[2] for name in names}) for excluded, names in said]


@pytest.mark.slow
def test_a_snapshot_is_sent_whole(tmp_path: Path) -> None:
    if not importlib.util.find_spec("sky"):
        pytest.skip("needs SkyPilot: pip install 'fogspec[sky]'")
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
    (excluded, names), (_, as_it_was) = sent_of(tmp_path / "sent.zip", snapshot, folder)
    assert excluded == []
    assert names == {*listed, ".skyignore"}
    assert "lib/model.onnx" not in as_it_was, "the folder itself would have been sent without it"
    assert ".env" in as_it_was, "and with what is nobody's"
