"""Launch files run in a sandbox as launch plays them, and start nothing; what is not taken over is said once, at its place."""

import contextlib
import json
import resource
from pathlib import Path
from typing import Any

import pytest

from fogspec.base import sandbox
from fogspec.base.diagnostics import DiagnosticError
from fogspec.cli import main
from fogspec.importers.launch import read_launch
from fogspec.importers.launch.found import LaunchImport
from fogspec.importers.scaffold import first_data
from fogspec.language.loader import load
from fogspec.language.robot_packages import reason_of
from fogspec.language.schema import Node
from tests.support.launch_facts import facts_of
from tests.support.sandboxed import loaded_sandbox  # noqa: F401

CASES = Path(__file__).resolve().parents[2] / "cases" / "launch"
GOLDEN = json.loads((CASES / "golden.json").read_text("utf-8"))
PLAIN = """\
from launch import *
from launch.actions import *
from launch.conditions import *
from launch.substitutions import *
from launch_ros.actions import *
from launch_ros.descriptions import *
import fogros2
import os


def generate_launch_description():
"""


ONE = "return LaunchDescription([Node(package='a', executable='b')])"


def written(folder: Path, body: str, name: str = "x.launch.py") -> Path:
    """A launch file whose function has this body."""
    path = folder / name
    path.write_text(PLAIN + "".join(f"    {line}\n" for line in body.splitlines()))
    return path


def nodes(found: LaunchImport) -> list[dict[str, Any]]:
    return [*found.cloud, *found.robot]


def messages(found: LaunchImport) -> list[str]:
    return [one.message for one in found.notes]


@pytest.mark.parametrize("name", sorted(GOLDEN))
def test_the_spec_starts_what_the_real_launch_started(name: str) -> None:
    """`golden.json` is what ROS 2's own launch did: `python -m tests.tools.launch.score FOLDER --oracle … --golden FILE`."""
    found = read_launch(CASES / "corpus" / name)
    spec = first_data("demo", found)["spec"]
    some = [Node.model_validate(one) for one in [*spec["cloud"], *spec.get("robot", [])]]
    files = {f"demo.params/{key}": text for key, text in found.files.items()}
    assert facts_of(some, files, {one.name: one for one in (CASES / "corpus").iterdir()}) == GOLDEN[name]


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
            "namespace": "/arm",
            "parameter_files": ["config/p.yaml"],
        }
    ]
    assert type(found.cloud[0]["parameters"]["gain"]) is float
    assert found.constraints == {"latency": "10ms", "cost": "0.01 cent/request"}
    assert found.hardware == {"cpus": "2..64"}
    assert (found.objective, found.stop) == ({"alpha": 0.7}, {"requests": 100})
    assert [one.span.line for one in found.notes] == [24, 25, 19]
    assert {one.code for one in found.notes} == {"FS802"}


@pytest.mark.parametrize("name", ["planner.launch.xml", "planner.launch.yaml"])
def test_xml_and_yaml_launch_files(name: str) -> None:
    (node,) = nodes(read_launch(CASES / name))
    assert (node["package"], node["executable"], node["remappings"]) == ("planner", "planner_node", {"/a": "/b"})
    assert node["parameters"]["rate"] == 10.0
    if name.endswith("xml"):
        assert node["arguments"] == ["--fast", "two words"]
        assert node["env"] == {"X": "1"}


def test_a_python_file_changes_nothing(tmp_path: Path) -> None:
    trap = tmp_path / "sprung"
    body = f"open({str(trap)!r}, 'w').close()\nos.system('touch {trap}')\n{ONE}"
    assert nodes(read_launch(written(tmp_path, body))) == [{"package": "a", "executable": "b"}]
    assert not trap.exists()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.launch.py", "def f(:\n", "Python"), ("a.launch.py", "(" * 500, "Python"), ("d.launch.py", "\x00", "text"),
        ("a.launch.py", "x = 1\n", "generate_launch_description"),
        ("b.launch.xml", "<launch><node></launch>", "XML"), ("b.launch.xml", "<nodes/>", "<launch>"),
        ("b.launch.xml", '<!DOCTYPE l [<!ENTITY a "aaa">]><launch>&a;</launch>', "DOCTYPE"),
        ("b.launch.xml", "<launch>" + "<group>" * 60 + "</group>" * 60 + "</launch>", "nested"),
        ("b.launch", '<launch><node pkg="a" type="b" name="c"/></launch>', "ROS 1"),
        ("b.launch.xml", '<launch><include file="$(find a)/b.launch"/></launch>', "ROS 1"),
        ("c.launch.yaml", "nodes: []\n", "launch:"), ("c.launch.yaml", "launch: [\n", ""),
    ],
)  # fmt: skip
def test_what_is_no_launch_file_is_refused_at_its_place(tmp_path: Path, name: str, content: str, said: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(DiagnosticError) as problems:
        read_launch(path)
    first = problems.value.diagnostics[0]
    assert first.code in ("FS801", "FS104", "FS103")
    assert first.span.path == str(path)
    assert said in first.message or first.code != "FS801"


# They end by the limit of processor time; that of the product is reached by the first program below.
ENDLESS = ("for i in range(10**12):\n    pass", "x = 10 ** 10 ** 10")


@pytest.mark.parametrize(
    "body",
    [
        "while True:\n    pass", *ENDLESS, "x = 'a' * 10**10", "x = [[0] * 10**5] * 10**5",
        "x = '{:>999999999}'.format(1)", "x = '%999999999d' % 1",
        "x = 'a'\nwhile len(x) > 0:\n    x = x + x",
        "def f(n):\n    return f(n + 1)\nf(0)", "def f(n):\n    return f(n + 1) + f(n + 2)\nf(0)",
        "x = " + "(" * 90 + "1" + ")" * 90, "import nothing_here\nnothing_here.f().g()[0](1)", "x = " + "+".join(["'a'"] * 900),
        "x = []\nx.append(x)\ny = str(x)", "raise RuntimeError('no')", "x = a\na = x\ny = a[0][1].b",
    ],
)  # fmt: skip
def test_a_hostile_program_is_bounded_and_ends_in_a_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str
) -> None:
    if body in ENDLESS:
        monkeypatch.setitem(sandbox.LIMITS, resource.RLIMIT_CPU, 1)
    path = written(tmp_path, body + "\nreturn LaunchDescription([Node(package='a', executable='b')])")
    with contextlib.suppress(DiagnosticError):
        assert nodes(read_launch(path))


ANSWER: dict[str, Any] = {
    "cloud": [], "robot": [], "said_cloud": False, "constrained": False, "constraints": {}, "objective": {}, "hardware": {},
    "stop": {}, "probe": {}, "infra": [], "image": None, "setup": [], "files": {}, "defaults": {}, "included": [], "notes": [],
    "failed": None,
}  # fmt: skip
FORGE = """\
for number in range(3, 64):
    try:
        os.write(number, b'A' + {answer!r}.encode())
    except OSError:
        pass
os._exit(0)
"""


def forged(folder: Path, answer: Any) -> Path:
    """A launch file that writes its reader's answer itself."""
    return written(folder, FORGE.format(answer=answer if isinstance(answer, str) else json.dumps(answer)))


@pytest.mark.parametrize(
    "answer",
    [
        "", "{", "[]", "null", {}, ANSWER | {"more": 1}, ANSWER | {"cloud": {}}, ANSWER | {"cloud": [{"package": 1}]},
        ANSWER | {"cloud": [{"shell": "rm"}]}, ANSWER | {"cloud": [{"launch": {"cwd": "/"}}]}, ANSWER | {"said_cloud": "yes"},
        ANSWER | {"robot": [{"parameters": {"a": {"b": 1}}}]}, ANSWER | {"files": {"../../.bashrc": "x"}},
        ANSWER | {"files": {"..": "x"}}, ANSWER | {"files": {"a/b": "x"}}, ANSWER | {"notes": [["/x", "1", 1, 1, "m"]]},
        ANSWER | {"included": "x"}, "[" * 100_000,
    ],
)  # fmt: skip
def test_a_forged_answer_is_refused(tmp_path: Path, answer: Any) -> None:
    with pytest.raises(DiagnosticError) as problems:
        read_launch(forged(tmp_path, answer))
    assert "forges its reader's answer" in problems.value.diagnostics[0].message


def test_a_forged_answer_shows_no_file_and_says_no_more_than_a_launch_file(tmp_path: Path) -> None:
    (tmp_path / "secret.key").write_text("only the user's")
    at = [f"{tmp_path}/secret.key", 1, 1, 1]
    node = {"package": "a", "executable": "b", "parameter_files": ["/etc/passwd", "../secret.key"], "place": at}
    found = read_launch(forged(tmp_path, ANSWER | {"robot": [node], "notes": [[*at, "\x1b[31mhere"]]}))
    assert [(one["package"], one["executable"]) for one in nodes(found)] == [("a", "b")]
    assert all("parameter_files" not in one for one in nodes(found))
    assert "only the user's" not in repr([found.notes, found.sources])


def test_parameter_files_that_are_written_while_it_launches_are_kept(tmp_path: Path) -> None:
    body = "import tempfile, yaml\nwith tempfile.NamedTemporaryFile('w', prefix='p_', delete=False) as file:\n"
    body += "    yaml.dump({'/**': {'ros__parameters': {'rate': 5}}}, file)\n    path = file.name\n"
    body += "return LaunchDescription([Node(package='a', executable='b', parameters=[path])])"
    found = read_launch(written(tmp_path, body))
    (node,) = nodes(found)
    assert messages(found) == []
    (name,) = found.files
    assert node["parameter_files"] == [f"@files/{name}"]
    assert "rate: 5" in found.files[name]


def test_a_temporary_name_is_the_same_each_time_and_a_written_file_stays_here(tmp_path: Path) -> None:
    body = "import tempfile\nworld = tempfile.mktemp(prefix='w_', suffix='.sdf')\n"
    body += "with tempfile.NamedTemporaryFile('w', delete=False) as file:\n    file.write('x')\n"
    body += "return LaunchDescription([Node(package='a', executable='b', arguments=['-o', world]),\n"
    body += "    Node(package='a', executable='c', arguments=[file.name])])"
    path = written(tmp_path, body)
    first, second = read_launch(path), read_launch(path)
    assert nodes(first) == nodes(second) == [
        {"package": "a", "executable": "b", "arguments": ["-o", "/tmp/w_00000001.sdf"]}, {"package": "a", "executable": "c"},
    ]  # fmt: skip
    assert [(note.span.line, note.message) for note in first.notes] == [
        (13, "a temporary file is new at each launch; in the spec it has the same name each time"),
        (14, "arguments of c are not taken over: it is a file that the launch file writes"),
    ]


def test_what_depends_on_where_packages_are_installed_is_left_out_and_named(tmp_path: Path) -> None:
    body = """\
from ament_index_python.packages import get_package_share_directory
share = get_package_share_directory('mine')
with tempfile.NamedTemporaryFile('w', prefix='p_', suffix='.yaml', delete=False) as file:
    file.write('/**: {ros__parameters: {depth: %d}}' % share.count('/'))
container = ComposableNodeContainer(package='c', executable='d', name='e', composable_node_descriptions=[
    ComposableNode(package='a', plugin='P', parameters=[{'long': len(share), 'map': share + '/map.yaml'}]),
    ComposableNode(package='a', plugin=share.split('/')[1])])
some = [container, Node(package='a', executable='b', name='one', arguments=['-d', share[7:]], remappings=[('x', share[1])],
        additional_env={'ROOT': share[:5]}, parameters=[file.name, {'k': share}])]
if 'ros2_ws' in share:
    some.append(Node(package='a', executable='elsewhere'))
if len(share) < 100:
    some.append(Node(package='a', executable='here'))
some.append(ExecuteProcess(cmd=['echo', share[3]]))
return LaunchDescription(some)"""
    found = read_launch(written(tmp_path, f"import tempfile\n{body}"))
    component = {"package": "a", "plugin": "P", "parameters": {"map": "$(find-pkg-share mine)/map.yaml"}}
    assert nodes(found) == [
        {"package": "c", "executable": "d", "name": "e", "composable_node_descriptions": [component]},
        {"package": "a", "executable": "b", "name": "one", "parameters": {"k": "$(find-pkg-share mine)"}},
        {"package": "a", "executable": "here"},
    ]
    assert found.files == {}
    lines: dict[int, set[str]] = {}
    for _, line, message in found.noted:
        lines.setdefault(line, set()).add(message.partition(" not taken over: it is computed")[0])
    moved = "whether this starts depends on where packages are installed: "
    assert lines == {
        17: {"the parameter long of P is", f"{moved}what starts is left out"},
        19: {"plugin of e is", "a component without a known package and plugin is left out"},
        20: {f"{what} of one {be}" for what, be in (("arguments", "are"), ("the remapping x", "is"),
             ("the environment variable ROOT", "is"), ("a parameter file", "is"))},
        23: {f"{moved}what starts is left out"}, 25: {f"{moved}it is taken as started"}, 26: {"echo is"},
    }  # fmt: skip


@pytest.mark.parametrize("trusted", [False, True])
def test_where_the_sandbox_lacks_a_layer_only_a_trusted_file_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], trusted: bool
) -> None:
    from fogspec.base import child

    start = (
        "import sys; from fogspec.base import sandbox; sandbox._landlock = lambda *_: False; sandbox.run(sys.argv[1])"
    )
    monkeypatch.setattr(child, "python", lambda module, *words: ["", "-I", "-c", start, *words])
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, ONE)
    with pytest.raises(SystemExit) as end:
        main(["init", "--name", "arm", "--from-launch", str(path), *(["--trust-launch"] if trusted else [])])
    said = capsys.readouterr().err
    assert (end.value.code, Path("specs/arm/arm.yaml").is_file()) == ((0, True) if trusted else (1, False)), said
    assert trusted or ("this machine lacks Landlock" in said and "--trust-launch" in said)


def test_launch_files_that_include_each_other_end(tmp_path: Path) -> None:
    for one, other in (("a", "b"), ("b", "a")):
        (tmp_path / f"{one}.launch.xml").write_text(
            f'<launch><node pkg="p" exec="{one}"/><include file="$(dirname)/{other}.launch.xml"/></launch>'
        )
    found = read_launch(tmp_path / "a.launch.xml")
    assert [node["executable"] for node in nodes(found)] == ["a", "b"]
    assert any("circle" in one for one in messages(found))


def test_remappings_keep_launch_s_order_and_the_first_for_a_name(tmp_path: Path) -> None:
    body = """\
from launch_ros.actions import SetRemap
rules = [('x', '/one'), ('/x', '/two'), ('a', '/three'), ('scan', '/four')]
return LaunchDescription([SetRemap('scan', '/first'), SetRemap('scan', '/second'),
                          Node(package='a', executable='b', remappings=rules)])"""
    (node,) = nodes(read_launch(written(tmp_path, body)))
    assert list(node["remappings"].items()) == [
        ("scan", "/first"), ("x", "/one"), ("/x", "/two"), ("a", "/three"),
    ]  # fmt: skip


def test_managed_nodes_are_activated_as_launch_does_or_it_is_said_that_nothing_does(tmp_path: Path) -> None:
    body = """\
from launch_ros.actions import LifecycleNode
from launch_ros.descriptions import ComposableLifecycleNode
from launch.substitutions import EnvironmentVariable
def managed(name, **words):
    return LifecycleNode(package='p', executable='e', name=name, namespace='', **words)
return LaunchDescription([
    DeclareLaunchArgument('auto', default_value='true'),
    managed('one', autostart=True), managed('two', autostart=LaunchConfiguration('auto')), managed('three', autostart=False),
    managed('four'), managed('managed'),
    managed(EnvironmentVariable('X'), autostart=True),
    Node(package='nav2_lifecycle_manager', executable='lifecycle_manager', parameters=[{'node_names': ['managed']}]),
    ComposableNodeContainer(package='rclcpp_components', executable='component_container', name='box', namespace='',
        composable_node_descriptions=[
            ComposableLifecycleNode(package='p', plugin='p::P', name='five', autostart=True),
            ComposableLifecycleNode(package='p', plugin='p::P', name='six'), ComposableNode(package='p', plugin='p::P')])])"""
    found = read_launch(written(tmp_path, body))
    by_name = {one.get("name"): one for one in nodes(found)}
    wanted = [name for name, one in by_name.items() if one.get("launch", {}).get("autostart")]
    assert [name for name in wanted if name] == ["one", "two"]
    parts = by_name["box"]["composable_node_descriptions"]
    assert [one.get("autostart", False) for one in parts] == [True, False, False]
    said = [one.partition(" is a managed node")[0] for one in messages(found) if "nothing in the spec activates" in one]
    assert said == ["three", "four", "six"]


XML = """\
<launch>
  <lifecycle_node pkg="p" exec="e" name="one" namespace="" autostart="true"/>
  <lifecycle_node pkg="p" exec="e" name="two" namespace=""/>
</launch>
"""


def test_managed_nodes_of_xml(tmp_path: Path) -> None:
    (tmp_path / "x.launch.xml").write_text(XML)
    found = read_launch(tmp_path / "x.launch.xml")
    assert [one.get("launch") for one in nodes(found)] == [{"autostart": True}, None]
    assert [one.span.line for one in found.notes] == [3]


NOT_ACTED_ON = """\
<launch>
  <arg name="mode" default="slow" description="how" unit="s"><choice value="slow"/><choice value="fast"/></arg>
  <node pkg="p" exec="e" name="one" output="screen" launch-prefix="nice" required="true" sigterm_timeout="2">
    <param name="a" value="1" unit="m"/>
    <remap from="x" to="y"/>
    <rosparam command="load"/>
    <env name="A" value="1"/>
  </node>
  <node pkg="p" exec="e" name="two" if="false" required="true"/>
  <group scoped="true" ns="arm"><node pkg="p" exec="e" name="three"/></group>
  <include file="$(dirname)/none.launch.xml"><remap from="a" to="b"/></include>
  <log message="hello" level="INFO"/>
  <reset><keep name="mode" value="fast"/></reset>
  <node pkg="p" exec="e" name="$(var mode)"/>
</launch>
"""


def test_each_attribute_and_element_that_is_not_acted_on_is_noted_once(tmp_path: Path) -> None:
    (tmp_path / "x.launch.xml").write_text(NOT_ACTED_ON.replace('    <rosparam command="load"/>\n', "    <wait/>\n"))
    found = read_launch(tmp_path / "x.launch.xml")
    assert messages(found)[0] == (
        "unit of <arg>, required of <node>, unit of <param>, <wait> in <node> and <remap> in <include> and ns of <group> are "
        "not taken over: a spec has no place for it (also in lines 3, 4, 6, 10 and 11)"
    )
    assert [one["name"] for one in nodes(found)] == ["one", "three", "fast"]


def test_a_choice_of_xml_is_launch_s(tmp_path: Path) -> None:
    (tmp_path / "x.launch.xml").write_text(NOT_ACTED_ON.replace("rosparam", "wait"))
    with pytest.raises(DiagnosticError, match="must be one of slow, fast"):
        read_launch(tmp_path / "x.launch.xml", {"mode": "medium"})


def test_each_keyword_that_is_not_acted_on_is_noted_once(tmp_path: Path) -> None:
    body = """\
return LaunchDescription([
    DeclareLaunchArgument('a', default_value='1', description='how', unit='s'), LogInfo(msg='hello'),
    TimerAction(period=1.0, cancel_on_shutdown=False, actions=[]), GroupAction([], scoped=True, isolated=True),
    Node(package='p', executable='e', name='one', output='screen', cwd='/tmp', respawn=False, respawn_delay=2.0),
    ExecuteProcess(cmd=['ls'], name='list', on_exit=[Shutdown(reason='over')], sigkill_timeout='5'),
    Node(package='p', executable='e', name='two', cwd='/tmp', condition=IfCondition('false'))])"""
    found = read_launch(written(tmp_path, body))
    assert messages(found)[0] == (
        "unit of DeclareLaunchArgument, isolated of GroupAction, cwd of one and on_exit of ls are not taken over: a spec has "
        "no place for it (also in lines 14, 15 and 16)"
    )


def test_what_is_of_the_whole_graph_is_left_out_and_named(tmp_path: Path) -> None:
    body = """\
return LaunchDescription([
    SetEnvironmentVariable('ROS_DOMAIN_ID', '42'), SetEnvironmentVariable('ROS_LOG_DIR', '/tmp'),
    Node(package='a', executable='b', name='one'),
    Node(package='a', executable='b', name='two', additional_env={'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp', 'A': '1'})])"""
    found = read_launch(written(tmp_path, body))
    assert [one["env"] for one in nodes(found)] == [{"ROS_LOG_DIR": "/tmp"}, {"ROS_LOG_DIR": "/tmp", "A": "1"}]
    assert any("ROS_DOMAIN_ID of one" in one and "of the whole graph" in one for one in messages(found)), messages(
        found
    )
    assert any("RMW_IMPLEMENTATION of two" in one for one in messages(found))


def test_launch_arguments_are_taken_as_ros2_launch_takes_them(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "return LaunchDescription([\n"
        "    DeclareLaunchArgument('use_sim_time', default_value='false'), DeclareLaunchArgument('needed'),\n"
        "    Node(package='a', executable='b', parameters=[{'use_sim_time': LaunchConfiguration('use_sim_time')}],\n"
        "         arguments=['-d', LaunchConfiguration('needed')])])",
    )
    assert refused(path) == "launch does not start without needed, which has no default"
    (node,) = nodes(found := read_launch(path, {"use_sim_time": "true", "needed": "x"}))
    assert (node["parameters"], node["arguments"]) == ({"use_sim_time": True}, ["-d", "x"])
    assert not found.notes


def refused(path: Path, given: dict[str, str] | None = None) -> str:
    with pytest.raises(DiagnosticError) as problems:
        read_launch(path, given)
    return problems.value.diagnostics[0].message


LASER = "DeclareLaunchArgument('laser', default_value='front', choices=['front', 'rear'])"


@pytest.mark.parametrize(
    ("actions", "given", "said"),
    [
        (LASER, {"laser": "raer"}, "launch does not start with laser:=raer: it must be one of front, rear"),
        (LASER.replace("'front', ch", "'top', ch"), {}, "launch does not start with laser:=top"),
        (
            "DeclareLaunchArgument('a'), DeclareLaunchArgument('b')",
            {},
            "launch does not start without a, b, which have no def",
        ),
        ("LogInfo(msg=LaunchConfiguration('c'))", {}, None),
        ("SetEnvironmentVariable('A', LaunchConfiguration('c'))", {}, "launch does not start without c"),
        (LASER, {"laser": "rear"}, None),
    ],
)
def test_what_launch_does_not_start_is_refused(
    tmp_path: Path, actions: str, given: dict[str, str], said: str | None
) -> None:
    path = written(tmp_path, f"return LaunchDescription([{actions}, Node(package='a', executable='b')])")
    if said is None:
        assert len(nodes(read_launch(path, given))) == 1
    else:
        assert refused(path, given).startswith(said)


def test_what_an_absent_file_may_have_given_is_noted_only(tmp_path: Path) -> None:
    body = """\
return LaunchDescription([
    IncludeLaunchDescription('/nowhere/x.launch.py'), DeclareLaunchArgument('needed'),
    Node(package='a', executable='b', name='one', namespace=LaunchConfiguration('space'))])"""
    found = read_launch(written(tmp_path, body))
    assert nodes(found) == [{"package": "a", "executable": "b", "name": "one"}]
    assert any("the launch argument space has no default" in one for one in messages(found)), messages(found)


def test_what_is_not_known_is_named_once(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "import mine\nwords = mine.load()\nreturn LaunchDescription([\n"
        "    Node(package='a', executable=name, parameters=[words]) for name in ('b', 'c')])",
    )
    found = read_launch(path)
    assert len(nodes(found)) == 2
    (note,) = found.notes
    assert (note.span.line, note.message) == (
        13, "parameters are not taken over: only a launch determines what mine.load() returns"
    ) or "mine.load()" in note.message  # fmt: skip


def test_what_one_reason_keeps_out_is_one_note_with_its_lines(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "import mine\nrate = mine.fps()\nreturn LaunchDescription([\n"
        "    Node(package='a', executable='b', parameters=[{'v': rate, 'w': rate}], remappings=[('x', rate)]),\n"
        "    TimerAction(period=2.0, actions=[Node(package='a', executable='c')]),\n"
        "    TimerAction(period=2.0, actions=[Node(package='a', executable='d')])])",
    )
    assert messages(read_launch(path)) == [
        "the parameter v, the parameter w and a remapping of b are not taken over: "
        "only a launch determines what mine.fps() returns",
        "a timer starts this 2.0 s after the launch: in the spec it starts with the rest (also in line 17)",
    ]


@pytest.mark.parametrize(
    ("made", "says"),
    [
        ("MoveItConfigsBuilder('panda', package_name='mine').joint_limits().to_moveit_configs()", "the package mine"),
        ("MoveItConfigsBuilder('panda').to_moveit_configs()", "the package panda_moveit_config"),
        ("MoveItConfigsBuilder(robot_name=LaunchConfiguration('r')).to_moveit_configs()", "a package"),
    ],
)  # fmt: skip
def test_moveits_builder_is_named_in_one_line(made: str, says: str, tmp_path: Path) -> None:
    path = written(
        tmp_path,
        f"from moveit_configs_utils import MoveItConfigsBuilder\nconfig = {made}\nreturn LaunchDescription([\n"
        "    Node(package='moveit_ros_move_group', executable='move_group', parameters=[config.to_dict()]),\n"
        "    Node(package='a', executable='b', parameters=[config.robot_description, config.joint_limits])])",
    )
    found = read_launch(path)
    assert len(nodes(found)) == 2
    (said,) = messages(found)
    assert said.startswith(
        "parameters of move_group and parameters of b are not taken over: MoveItConfigsBuilder reads them from "
        f"{says} while it launches"
    )
    assert "'cmd: [ros2, launch, ...]'" in said


def test_what_only_xacro_makes_is_named_with_its_file_and_node(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "import xacro\nrobot = xacro.process_file('/robot.xacro', mappings={'arm': 'left'})\nreturn LaunchDescription([\n"
        "    Node(package='a', executable='b', parameters=[{'robot_description': robot.toxml()}]),\n"
        "    Node(package='a', executable='c', parameters=[{'joints': robot.getElementsByTagName('joint').length}])])",
    )
    found = read_launch(path)
    assert nodes(found)[0]["parameters"] == {"robot_description": "$(command 'xacro /robot.xacro arm:=left')"}
    assert [(one.span.line, one.message) for one in found.notes] == [
        (16, "the parameter joints of c is not taken over: only the machine has what xacro makes of /robot.xacro")
    ]


def test_where_nothing_can_be_read_the_spec_starts_the_launch_file(tmp_path: Path) -> None:
    (tmp_path / "package.xml").write_text("<package><name>mine</name></package>")
    path = written(tmp_path, "import mine\nreturn mine.describe()")
    found = read_launch(path, {"a": "1"})
    assert nodes(found) == [{"cmd": ["ros2", "launch", "mine", "x.launch.py", "a:=1"]}]
    assert len(found.notes) == 2


def test_an_included_file_that_is_elsewhere_is_followed_where_it_is(tmp_path: Path) -> None:
    far = tmp_path / "prefix" / "share" / "far"
    (far / "launch").mkdir(parents=True)
    (far / "package.xml").write_text("<package><name>far</name></package>")
    (far / "launch" / "far.launch.xml").write_text('<launch><node pkg="far" exec="$(var rate)"/></launch>')
    (tmp_path / "here").mkdir()
    path = tmp_path / "here" / "x.launch.xml"
    path.write_text(
        '<launch><include file="$(find-pkg-share far)/launch/far.launch.xml"><arg name="rate" value="7"/></include></launch>'
    )
    assert nodes(read_launch(path)) == [{"cmd": ["ros2", "launch", "far", "far.launch.xml", "rate:=7"]}]
    found = read_launch(path, package_paths=[tmp_path / "prefix"])
    assert nodes(found) == [{"package": "far", "executable": "7"}]
    assert found.origins[id(nodes(found)[0])].path.endswith("far.launch.xml")


@pytest.mark.parametrize(
    ("node", "stays"),
    [
        ({"package": "rviz2", "executable": "rviz2"}, True), ({"package": "nav2_planner", "executable": "x"}, False),
        ({"package": "realsense2_camera", "executable": "x"}, True),
        ({"cmd": ["gz", "sim"]}, True), ({"cmd": ["python3", "x.py"]}, False),
        ({"cmd": ["ros2", "launch", "ros_gz_sim", "gz_sim.launch.py"]}, True),
        ({"package": "rclcpp_components", "executable": "x",
          "composable_node_descriptions": [{"package": "usb_cam", "plugin": "y"}]}, True),
    ],
)  # fmt: skip
def test_what_belongs_on_the_robot_is_proposed_with_its_reason(node: dict[str, Any], stays: bool) -> None:
    assert (reason_of(node) is not None) is stays


def test_cloud_and_robot_are_divided_and_the_spec_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    written(
        tmp_path,
        "return LaunchDescription([Node(package='nav2_planner', executable='planner_server'),\n"
        "    Node(package='rviz2', executable='rviz2')])",
    )
    with pytest.raises(SystemExit) as end:
        main(["init", "--from-launch", "x.launch.py", "--name", "nav", "unused:=1"])
    assert end.value.code == 0
    (loaded,) = load(["specs/nav/nav.yaml"])
    assert [node.package for node in loaded.application.spec.cloud] == ["nav2_planner"]
    assert [node.package for node in loaded.application.spec.robot] == ["rviz2"]
    text = Path("specs/nav/nav.yaml").read_text("utf-8")
    assert "# x.launch.py:13: proposed for the robot, because it shows the robot's data on a screen" in text
    assert "# Launch arguments: unused:=1" in text


def test_fogros2s_machines_containers_topics_and_analyser(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "ld = fogros2.FogROSLaunchDescription()\n"
        "machine = fogros2.AWSCloudInstance(region='us-west-1', ec2_instance_type='c5.4xlarge', ami_image='ami-1')\n"
        "machine.add_docker_container('sudo docker run --rm --net=host slam ros2 launch orb_slam2_ros rgbd.launch.py')\n"
        "topics = [('/camera', 'h264')]\n"
        "ld.add_action(fogros2.CloudNode(package='a', executable='talker', machine=machine, stream_topics=topics))\n"
        "ld.add_action(Node(package='a', executable='listener'))\n"
        "fogros2.SkyLaunchDescription(nodes=[], mode='benchmark', containers=[\n"
        "    'sudo docker run latency ros2 run fogros2 latency --ros-args -p request_topic_name:=/camera/image'\n"
        "    ' -p response_topic_name:=/pose -p heuristic_mode:=first_request'])\n"
        "return ld",
    )
    found = read_launch(path)
    assert found.infra == ["aws/us-west-1"]
    assert found.probe == {"request": "/camera/image", "response": "/pose", "match": "first_request"}
    assert [node.get("executable") or node["cmd"][:3] for node in found.cloud] == [
        ["sudo", "docker", "run"], "republish", "talker"
    ]  # fmt: skip
    assert [node["executable"] for node in found.robot] == ["republish", "listener"]
    assert found.cloud[1]["remappings"] == {"in/h264": "/camera/h264", "out": "/camera/cloud"}
    assert [one.split(" is ")[0] for one in messages(found)] == ["ec2_instance_type=c5.4xlarge", "ami_image"]


@pytest.mark.parametrize(
    ("machine", "infra", "image"),
    [
        ("GCPCloudInstance(project_id='p', zone='us-central1-a')", ["gcp/us-central1/us-central1-a"], None),
        ("KubeInstance(container_image='me/app:1')", ["kubernetes"], "me/app:1"),
    ],
)
def test_fogros2s_other_machines(tmp_path: Path, machine: str, infra: list[str], image: str | None) -> None:
    body = f"return LaunchDescription([fogros2.CloudNode(package='a', executable='b', machine=fogros2.{machine})])"
    found = read_launch(written(tmp_path, body))
    assert (found.infra, found.image) == (infra, image)
    assert found.cloud == [{"package": "a", "executable": "b"}]


@pytest.mark.parametrize(
    "launch",
    [
        None,
        "grasp.launch.py",
        "planner.launch.xml",
        "planner.launch.yaml",
        *(f"corpus/{one}" for one in sorted(GOLDEN)),
    ],
)
def test_init_writes_a_valid_commented_spec_and_overwrites_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launch: str | None
) -> None:
    monkeypatch.chdir(tmp_path)
    argv = ["init", "--name", "arm", *(["--from-launch", str(CASES / launch)] if launch else [])]
    with pytest.raises(SystemExit) as end:
        main(argv)
    assert end.value.code == 0
    text = Path("specs/arm/arm.yaml").read_text("utf-8")
    assert text.startswith("# yaml-language-server: $schema=../../schemas/Application.json\n")
    assert text.count("#") > 20
    assert Path("schemas/Application.json").is_file()
    (loaded,) = load(["specs/arm/arm.yaml"])
    assert loaded.application.metadata.name == "arm"
    with pytest.raises(SystemExit) as end:
        main(argv)
    assert end.value.code == 2
    assert Path("specs/arm/arm.yaml").read_text("utf-8") == text
