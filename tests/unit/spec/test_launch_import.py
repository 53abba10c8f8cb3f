"""Launch files are read and never run; what could not be read is said, at its place."""

from pathlib import Path

import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.cli import main
from fogspec.spec.launch_import import read_launch
from fogspec.spec.loader import load

CASES = Path(__file__).resolve().parents[2] / "cases" / "launch"


def test_the_papers_python_launch_file() -> None:
    found = read_launch(CASES / "grasp.launch.py")
    assert found.cloud == [
        {
            "package": "fogros2_examples", "executable": "grasp_planning_node", "name": "planner",
            "parameters": {"model": "GQCNN-4.0-PJ", "gain": 38.0, "rate": 10}, "remappings": {"/image": "/camera/image"},
        }
    ]  # fmt: skip
    assert found.robot == [
        {
            "package": "fogros2_examples",
            "executable": "client",
            "namespace": "arm",
            "parameter_files": ["config/p.yaml"],
        }
    ]
    assert type(found.cloud[0]["parameters"]["gain"]) is float
    assert found.constraints == {"latency": "10ms", "cost": "0.01 cent/request"}
    assert found.hardware == {"cpus": "2..64"}
    assert (found.objective, found.stop) == ({"alpha": 0.7}, {"requests": 100})
    said = [
        (one.span.line, one.source_line[one.span.column - 1 :][: one.span.width])
        for one in found.notes
        if one.source_line
    ]
    assert said == [
        (14, 'LaunchConfiguration("model")'), (19, "0.01"), (24, 'os.environ["X"]'),
        (25, 'IncludeLaunchDescription("other.launch.py")'),
    ]  # fmt: skip
    assert {one.code for one in found.notes} == {"FS802"}


@pytest.mark.parametrize("name", ["planner.launch.xml", "planner.launch.yaml"])
def test_xml_and_yaml_launch_files(name: str) -> None:
    (node,) = read_launch(CASES / name).robot
    assert (node["package"], node["executable"], node["remappings"]) == ("planner", "planner_node", {"/a": "/b"})
    assert node["parameters"]["rate"] == 10.0
    if name.endswith("xml"):
        assert node["arguments"] == ["--fast", "two words"]
        assert node["env"] == {"X": "1"}


def test_a_python_file_is_not_run(tmp_path: Path) -> None:
    trap = tmp_path / "sprung"
    launch = tmp_path / "evil.launch.py"
    launch.write_text(
        f"open({str(trap)!r}, 'w').close()\nfrom launch_ros.actions import Node\nNode(package='a', executable='b')\n"
    )
    assert read_launch(launch).robot == [{"package": "a", "executable": "b"}]
    assert not trap.exists()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.launch.py", "def f(:\n"), ("a.launch.py", "(" * 500), ("b.launch.xml", "<launch><node></launch>"),
        ("b.launch.xml", "<nodes/>"),
        ("b.launch.xml", '<!DOCTYPE l [<!ENTITY a "aaa">]><launch>&a;</launch>'), ("c.launch.yaml", "nodes: []\n"),
        ("c.launch.yaml", "launch: [\n"), ("d.launch.py", "\x00"),
    ],
)  # fmt: skip
def test_what_is_no_launch_file_is_refused_at_its_place(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(DiagnosticError) as problems:
        read_launch(path)
    assert problems.value.diagnostics[0].code in ("FS801", "FS104", "FS103")
    assert problems.value.diagnostics[0].span.path == str(path)


@pytest.mark.parametrize(
    ("body", "cloud", "robot"),
    [
        ("ld.add_action(Node(package='a', executable='b', to_cloud=True))", ["b"], []),
        ("CloudNode(package='a', executable='b', machine=m)", ["b"], []),
        (
            "n = Node(package='a', executable='b')\nSkyLaunchDescription(nodes=[n])\nNode(package='a', executable='c')",
            ["b"],
            ["c"],
        ),
        (
            "n = Node(package='a', executable='b')\nn = Node(package='a', executable='c')\nSkyLaunchDescription([n])",
            [],
            ["b", "c"],
        ),
        ("Node(package=f(), executable='b')", [], []),
        ("x = 'b'\nNode(package='a', executable=x + '_node')", [], ["b_node"]),
    ],
)
def test_where_nodes_go(tmp_path: Path, body: str, cloud: list[str], robot: list[str]) -> None:
    path = tmp_path / "x.launch.py"
    path.write_text(body + "\n")
    found = read_launch(path)
    assert [node["executable"] for node in found.cloud] == cloud
    assert [node["executable"] for node in found.robot] == robot


def test_names_in_a_circle_end(tmp_path: Path) -> None:
    path = tmp_path / "x.launch.py"
    path.write_text(
        "a = b\nb = a\nNode(package=a, executable='x')\nc = [c]\nNode(package='p', executable='x', arguments=c)\n"
    )
    found = read_launch(path)
    assert [node["executable"] for node in found.robot] == ["x"]
    assert len(found.notes) >= 2


@pytest.mark.parametrize("launch", [None, "grasp.launch.py", "planner.launch.xml", "planner.launch.yaml"])
def test_init_writes_a_valid_commented_spec_and_overwrites_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launch: str | None
) -> None:
    monkeypatch.chdir(tmp_path)
    argv = ["init", "--name", "arm", *(["--from-launch", str(CASES / launch)] if launch else [])]
    with pytest.raises(SystemExit) as end:
        main(argv)
    assert end.value.code == 0
    text = Path("specs/arm.yaml").read_text("utf-8")
    assert text.startswith("# yaml-language-server: $schema=../schemas/Application.json\n")
    assert text.count("#") > 20
    assert Path("schemas/Application.json").is_file()
    (loaded,) = load(["specs/arm.yaml"])
    assert loaded.application.metadata.name == "arm"
    with pytest.raises(SystemExit) as end:
        main(argv)
    assert end.value.code == 2
    assert Path("specs/arm.yaml").read_text("utf-8") == text
