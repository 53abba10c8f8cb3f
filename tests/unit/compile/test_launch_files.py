"""Generated launch files: run against a recorder, they start exactly the spec's nodes, with their words unchanged."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fogspec.base.layout import Layout
from fogspec.compile.launch_files import launch_files, robot_launch
from fogspec.compile.launch_source import flat
from fogspec.compile.tasks import deployed_processes, measured_processes
from fogspec.importers.launch import read_launch
from fogspec.language.schema import Application
from tests.support.launching import launched
from tests.unit.compile.test_tasks import NASTY, application

NODE = {
    "package": "planner", "executable": "plan", "name": "planner", "namespace": "/arm", "parameter_files": ["config/p.yaml"],
    "parameters": {"gain": 38.0, "rate": 38, "text": "7", "on": "yes", "deep": {"flag": True}, "list": [1.0, 2.0],
                   "nasty": NASTY},
    "remappings": {"x": "/y", "/x": "/z", "a": "b"}, "arguments": ["--fast", NASTY], "env": {"B": "2", "NASTY": NASTY},
}  # fmt: skip


def written(app: Application, root: Path) -> Layout:
    layout = Layout.of(root / "specs" / "x.yaml", app.metadata.name)
    files = launch_files(app, layout)
    robot = robot_launch(app, layout)
    for path, content in {**files, **({layout.robot: robot} if robot else {})}.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return layout


def content_of(file: str) -> dict[str, Any]:
    """Return the parameters in a file that a launch file wrote, and remove it."""
    content = json.loads(Path(file).read_text("utf-8"))
    Path(file).unlink()
    assert list(content) == ["/**"], "of the node, whatever its name: as `-p` is meant"
    return content["/**"]["ros__parameters"]


def test_the_clouds_launch_file_starts_the_nodes_as_the_spec_says(tmp_path, monkeypatch):
    layout = written(application(cloud=[NODE, {"cmd": ["printf", NASTY], "arguments": ["more"]}], ros={}), tmp_path)
    monkeypatch.chdir(tmp_path)
    node, process = launched(layout.cloud)
    words = node.keywords
    assert {key: words[key] for key in ("package", "executable", "name", "namespace")} == {
        key: NODE[key] for key in ("package", "executable", "name", "namespace")
    }
    file, parameters = words["parameters"]
    assert file == str(tmp_path / "config" / "p.yaml")
    assert repr(content_of(parameters)) == repr(dict(flat(NODE["parameters"]))), (
        "types untouched: 38.0 stays 38.0, '7' a text"
    )
    assert words["remappings"] == list(NODE["remappings"].items()), "the first that matches counts"
    assert words["arguments"] == NODE["arguments"]
    assert words["additional_env"] == NODE["env"]
    assert process.keywords["cmd"] == ["printf", NASTY, "more"]
    assert words["exec_name"] == NODE["name"], "the name in front of what it prints"
    assert process.keywords["name"].startswith("printf ")
    assert process.keywords["name"].isprintable()
    assert all(one.keywords["on_exit"].kind == "Shutdown" for one in (node, process)), "when one ends, all end"


def test_the_robots_launch_file_finds_the_specs_files_from_anywhere(tmp_path, monkeypatch):
    layout = written(application(robot=[NODE, {"cmd": ["./drive"]}]), tmp_path)
    monkeypatch.chdir("/")
    node, process = launched(layout.robot)
    assert Path(node.keywords["parameters"][0]).resolve() == tmp_path / "specs" / "config" / "p.yaml"
    assert Path(process.keywords["cwd"]).resolve() == tmp_path / "specs"
    assert "on_exit" not in node.keywords, "the robot goes on when one node ends"


@pytest.mark.parametrize(("link", "rmw"), [("zenoh", "RMW_IMPLEMENTATION"), ("wireguard", "ROS_STATIC_PEERS")])
def test_with_a_link_the_robot_starts_its_end_before_its_nodes(tmp_path, link, rmw):
    app = application(robot=[NODE], ros={}, connectivity={"link": link, "expose": {"/t": "topic"}})
    layout = written(app, tmp_path)
    first, *others, begun, tunnel, node = launched(layout.robot)
    assert (first.kind, first.arguments[0]) == ("SetEnvironmentVariable", rmw)
    assert all(one.kind == "SetEnvironmentVariable" for one in others)
    assert all(Path(one.arguments[1]).is_file() for one in others), "a profile that is there"
    assert begun.kind == "OpaqueFunction"
    assert tunnel.keywords["cmd"] == ["bash", str(layout.link / "link.sh"), "robot", "up"]
    assert node.kind == "Node"


CONTAINER = {
    "package": "rclcpp_components", "executable": "component_container", "name": "vision", "namespace": "/camera",
    "composable_node_descriptions": [
        {"package": "image_proc", "plugin": "image_proc::RectifyNode", "name": "rectify", "parameters": {"queue_size": 5},
         "remappings": {"image": "image_raw"}, "extra_arguments": {"use_intra_process_comms": True}},
    ],
}  # fmt: skip


def test_a_container_is_one_process_with_its_components(tmp_path):
    layout = written(application(robot=[CONTAINER]), tmp_path)
    (container,) = launched(layout.robot)
    assert container.kind == "ComposableNodeContainer"
    assert (container.keywords["name"], container.keywords["namespace"]) == ("vision", "/camera")
    (component,) = container.keywords["composable_node_descriptions"]
    assert component.keywords == {
        "package": "image_proc", "plugin": "image_proc::RectifyNode", "name": "rectify", "parameters": [{"queue_size": 5}],
        "remappings": [("image", "image_raw")], "extra_arguments": [{"use_intra_process_comms": True}],
    }  # fmt: skip


def test_a_container_is_measured_by_a_launch_file_of_its_own(tmp_path):
    (process,) = measured_processes(application(cloud=[CONTAINER], ros={}).spec)
    assert isinstance(process, dict)
    argv = process["argv"]
    assert argv[:3] == ["python3", "-m", "fogspec_agent.launch"]
    (tmp_path / "one.launch.py").write_text(argv[3], "utf-8")
    (container,) = launched(tmp_path / "one.launch.py")
    assert container.kind == "ComposableNodeContainer"
    assert container.keywords["on_exit"].kind == "Shutdown"


def test_substitutions_are_launchs_own(tmp_path):
    node = {
        "package": "p", "executable": "e", "parameter_files": ["$(find-pkg-share p)/a.yaml"],
        "arguments": ["-d", "$(env HOME)/x"],
        "parameters": {"map": "$(find-pkg-share p)/map.yaml", "cost": "$5"},
        "launch": {"prefix": "nice -n 5", "respawn": True, "respawn_delay": "2s"},
    }  # fmt: skip
    (one,) = launched(written(application(robot=[node]), tmp_path).robot)
    words = one.keywords
    file, plain, values = words["parameters"]
    assert (file.kind, file.arguments[0][0].arguments, file.arguments[0][1]) == ("ParameterFile", ("p",), "/a.yaml")
    assert values["map"].keywords == {"value_type": str}
    assert content_of(plain) == {"cost": "$5"}
    assert words["arguments"][1][0].kind == "EnvironmentVariable"
    assert (words["prefix"], words["respawn"], words["respawn_delay"]) == ("nice -n 5", True, 2.0)


def test_a_robot_without_nodes_still_gets_its_end_of_the_link(tmp_path):
    app = application(ros={}, connectivity={"link": "zenoh", "expose": {"/t": "topic"}})
    assert [one.kind for one in launched(written(app, tmp_path).robot)] == [
        "SetEnvironmentVariable", "OpaqueFunction", "ExecuteProcess"
    ]  # fmt: skip
    assert robot_launch(application(), Layout.of("specs/x.yaml", "app")) is None


MANAGED = [
    {"package": "p", "executable": "e", "name": "planner", "namespace": "arm/", "launch": {"autostart": True}},
    {"package": "p", "executable": "e", "name": "other"},
    {**CONTAINER, "composable_node_descriptions": [
        {"package": "p", "plugin": "p::P", "name": "map", "namespace": "/maps", "autostart": True},
        {"package": "p", "plugin": "p::P", "name": "rest"},
    ]},
]  # fmt: skip


def test_managed_nodes_are_activated_by_one_program_wherever_they_start(tmp_path):
    words = ["--of", "/arm/planner", "--of", "/maps/map"]
    spec = {"probe": {"service": "/plan"}, "benchmark": {"workload": {"node": {"cmd": ["./client"]}}}}
    app = application(cloud=MANAGED, ros={}, **spec)
    *nodes, activates, client = measured_processes(app.spec)[-5:]
    assert activates == ["python3", "-m", "fogspec_agent.activate", *words]
    assert [one["name"] for one in [*nodes, client]] == ["planner", "other", "vision", "client"]
    assert deployed_processes(app)[-1] == {"argv": activates, "name": "activate", "respawn": "always"}
    layout = written(application(robot=MANAGED, ros={}), tmp_path)
    *nodes, activates = launched(layout.robot)
    assert [one.kind for one in nodes] == ["Node", "Node", "ComposableNodeContainer"]
    agent = activates.keywords["cmd"].pop(1)
    assert Path(agent).resolve() == layout.agent.resolve()
    assert activates.keywords == {
        "cmd": ["python3", "activate", *words], "output": "screen", "respawn": True, "respawn_delay": 2.0,
    }  # fmt: skip
    plain = application(robot=MANAGED[1:2], cloud=MANAGED[1:2], ros={}, **spec)
    assert "AGENT" not in written(plain, tmp_path).robot.read_text()
    assert "activate" not in str(measured_processes(plain.spec)) + str(deployed_processes(plain))


def test_without_ros_there_is_no_launch_file_for_the_cloud():
    assert launch_files(application(cloud=[{"cmd": ["./x"]}]), Layout.of("specs/x.yaml", "app")) == {}


def test_init_reads_the_generated_file_back_as_the_same_nodes(tmp_path):
    """Parameters come back in the file that it writes."""
    node = {key: value for key, value in NODE.items() if key != "parameter_files"}
    layout = written(application(robot=[node]), tmp_path)
    found = read_launch(layout.robot)
    del node["parameters"]
    assert found.cloud == [node | {"parameter_files": ["@files/launch.yaml"]}]
    assert yaml.safe_load(found.files["launch.yaml"])["/**"]["ros__parameters"] == dict(flat(NODE["parameters"]))
    assert not found.notes


def test_a_source_with_a_line_feed_in_its_name_stays_a_comment(tmp_path):
    app = application(robot=[{"package": "p", "executable": "e"}])
    text = robot_launch(app, Layout.of(tmp_path / "a\nimport os; os.abort()\n#.yaml", "app"))
    assert text is not None
    compile(text, "robot.launch.py", "exec")
    assert not any(line.startswith(b"import os") for line in text.splitlines())


texts = st.text(max_size=30)
values = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False) | texts,
    lambda inner: st.dictionaries(texts, inner, max_size=3) | st.lists(texts, min_size=1, max_size=3), max_leaves=8,
)  # fmt: skip


@pytest.mark.slow
@given(
    st.dictionaries(texts, values, max_size=4), st.lists(texts, max_size=3), st.dictionaries(texts, texts, max_size=3)
)
def test_any_words_come_out_as_they_went_in(tmp_path_factory, parameters, arguments, env):
    node = {"package": "p", "executable": "e", "parameters": parameters, "arguments": arguments, "env": env}
    folder = tmp_path_factory.mktemp("any")
    (one,) = launched(written(application(robot=[node]), folder).robot)
    got = one.keywords
    some = got.get("parameters") or [None]
    assert repr(content_of(some[-1]) if some[-1] else {}) == repr(dict(flat(parameters)))
    assert got.get("arguments", []) == arguments
    assert got.get("additional_env", {}) == env
