"""Each launch file of the corpus is imported, compiled and started: what starts is what the real launch starts."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from fogspec.base.layout import Layout
from fogspec.cli import main
from fogspec.compile.launch_files import launch_files, robot_launch
from fogspec.compile.launch_source import node_launch
from fogspec.language.loader import load
from tests.support.sandboxed import loaded_sandbox  # noqa: F401
from tests.support.stubs import facts, played

CASES = Path(__file__).resolve().parents[2] / "cases" / "launch"
CORPUS = CASES / "corpus"
FILES = sorted(str(one.relative_to(CORPUS)) for one in CORPUS.glob("*/launch/*"))
GOLDEN = json.loads((CASES / "golden.json").read_text("utf-8"))
# Of modules that no wheel has, so that the real launch did not play them.
NOT_PLAYED = {
    "demo_bringup/launch/listing.launch.py": ["<demo_robot>/client", "<demo_robot>/planner"],
    "demo_bringup/launch/moveit.launch.py": ["<demo_robot>/grasp", "<moveit_ros_move_group>/move_group"],
}


def test_the_corpus_has_forty_files_that_the_real_launch_played_or_cannot() -> None:
    assert len(FILES) >= 40
    assert GOLDEN.keys() | NOT_PLAYED.keys() == set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_a_launch_file_is_imported_compiled_and_started(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["init", "--name", "demo", "--from-launch", str(CORPUS / name)])
    assert end.value.code == 0, capsys.readouterr().err
    (one,) = load(["specs/demo/demo.yaml"])
    layout, prefix = Layout.of(tmp_path / "specs" / "demo" / "demo.yaml", "demo"), tmp_path / "prefix"
    spec = one.application.spec
    unlinked = spec.connectivity.model_copy(update={"link": "none"})
    app = one.application.model_copy(update={"spec": spec.model_copy(update={"connectivity": unlinked})})
    shutil.copytree(CORPUS, prefix / "share")
    started: list[dict[str, Any]] = []
    again = [
        node_launch(node).encode() for node in app.spec.cloud if node.launch.respawn
    ]  # each in a process of its own
    files = [launch_files(app, layout).get(layout.cloud), robot_launch(app, layout), *again]
    for number, content in enumerate(files):
        if content is not None:
            # As far below the project as where compile puts it: it finds the spec's files from there.
            at = layout.cloud.parent.parent / f"demo{number}" / "one.launch.py"
            at.parent.mkdir(parents=True)
            at.write_bytes(content)
            started += facts(played(at, prefix, layout.spec.parent), prefix, layout.spec.parent, at.parent)
    started.sort(key=lambda fact: json.dumps(fact, sort_keys=True))
    if name in GOLDEN:
        assert [_plain(fact) for fact in started] == [_plain(fact) for fact in GOLDEN[name]]
    else:
        assert [fact["executable"] for fact in started] == NOT_PLAYED[name]


def _plain(fact: dict[str, Any]) -> str:
    return json.dumps(fact, sort_keys=True)
