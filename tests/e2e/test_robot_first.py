"""ROS 2 where it is needed, what moves the robot stays on it, a link between both: on files, through the command line."""

import json
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.support.running import Shell, measure, project, shell, spec  # noqa: F401

TOPICS = "{request: /image, response: /pose}"
WORKLOAD = "{budget: $5, workload: {node: {cmd: [python3, work.py]}}}"
HEAD = """\
from launch import LaunchDescription
from launch_ros.actions import LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    return LaunchDescription([
"""


def imported(shell: Shell, *lines: str, name: str = "app", at: str = "src/my_nav", code: int = 0) -> tuple[dict, str]:
    """The body of the spec that `init` writes for a launch file of these actions, and what it prints."""
    shell.write(f"{at}/package.xml", "<package><name>my_nav</name></package>")
    body = "".join(f"        {line},\n" for line in lines)
    shell.write(f"{at}/launch/{name}.launch.py", f"{HEAD}{body}    ])\n")
    ended = shell("init", f"{name}.yaml", "--from-launch", f"{at}/launch/{name}.launch.py", code=code)
    return YAML(typ="safe", pure=True).load(shell.read(f"{name}.yaml"))["spec"], ended.out + ended.err


def node(package: str, name: str, more: str = "") -> str:
    return f"Node(package={package!r}, executable='run', name={name!r}{more})"


def names(nodes: list[dict]) -> set[str]:
    return {one["name"] for one in nodes}


@pytest.mark.parametrize(
    ("parts", "where", "what"),
    [
        ({"probe": TOPICS}, 6, "spec.probe.request is observed in a ROS 2 graph"),
        ({"probe": "{service: /plan}"}, 6, "spec.probe.service is observed in a ROS 2 graph"),
        ({"probe": "{action: /go}"}, 6, "spec.probe.action is observed in a ROS 2 graph"),
        ({"cloud": "[{package: a, executable: b}]"}, 5, "spec.cloud[0] is a ROS 2 node"),
        ({"cloud": "[{cmd: [ros2, launch, a, b.launch.py]}]"}, 5, "spec.cloud[0].cmd starts ros2"),
        ({"cloud": "[{cmd: [bash, -c, 'exec ros2 run a b']}]"}, 5, "spec.cloud[0].cmd starts ros2"),
        (
            {"benchmark": "{budget: $5, workload: {node: {package: a, executable: b}}}"},
            11,
            "spec.benchmark.workload.node is a ROS 2 node",
        ),
        ({"metrics": "{m: {topic: /m, field: data}}"}, 12, "spec.metrics.m is observed in a ROS 2 graph"),
        ({"deployment": "{ready: [ros2, topic, echo, --once, /pose]}"}, 12, "spec.deployment.ready starts ros2"),
    ],
)
def test_what_needs_ros_says_so_at_its_place_and_the_block_to_paste_mends_it(
    shell: Shell, parts: dict[str, str], where: int, what: str
) -> None:
    shell.write("specs/work.py", "")
    shell.write("specs/demo.yaml", spec(**parts))
    said = shell("validate", "specs/demo.yaml", code=1).err
    assert f"error[FS503]: spec.ros is missing, and {what}" in said
    assert f"--> specs/demo.yaml:{where}:" in said
    shell("compile", "specs/demo.yaml", code=1)
    block = said.partition("add '")[2].partition("'")[0]
    shell.write("specs/demo.yaml", spec(**parts) + f"  {block}\n")
    shell("validate", "specs/demo.yaml")


@pytest.mark.parametrize(
    "parts",
    [
        {},
        {"cloud": "[{cmd: [python3, tools/ros2.py]}]", "robot": "[{package: a, executable: b}]"},
        {"probe": TOPICS, "ros": "{image: docker.io/library/ros:jazzy}"},
    ],
    ids=["a plain process", "nodes of the robot only", "an image with ROS in it"],
)
def test_what_needs_no_further_ros_is_valid(shell: Shell, parts: dict[str, str]) -> None:
    shell.write("specs/work.py", "")
    shell.write("specs/tools/ros2.py", "")
    shell.write("specs/demo.yaml", spec(**parts))
    shell("validate", "specs/demo.yaml")


def test_init_writes_ros_and_the_workspace_that_has_the_package(shell: Shell) -> None:
    unread, _ = imported(shell, "mine()")
    assert unread["cloud"] == [{"cmd": ["ros2", "launch", "my_nav", "app.launch.py"]}]
    # Machines of AWS, which it proposes, have no packages of Jazzy.
    assert unread["ros"] == {"distro": "jazzy", "image": "docker.io/library/ros:jazzy", "workspace": "."}
    shell("validate", "app.yaml")
    below, _ = imported(shell, node("my_nav", "a"), name="below", at="robot_ws/src/group/my_nav")
    assert below["ros"]["workspace"] == "robot_ws"
    shell.write("../elsewhere/src/far/package.xml", "<package><name>far</name></package>")
    shell.write("../elsewhere/src/far/far.launch.xml", '<launch><node pkg="far" exec="b"/></launch>')
    shell("init", "specs/far.yaml", "--from-launch", "../elsewhere/src/far/far.launch.xml")
    far = shell.read("specs/far.yaml")
    assert "workspace: ros2_ws " in far
    assert "# ../../elsewhere/src/far is sent to no machine: copy its package into ros2_ws/src beside this spec." in far


def test_what_moves_the_robot_stays_on_it(shell: Shell) -> None:
    managed = ", parameters=[{'node_names': ['planner', 'monitor']}]"
    app, _ = imported(
        shell,
        node("nav2_collision_monitor", "monitor"),
        node("nav2_velocity_smoother", "smoother"),
        node("nav2_controller", "controller"),
        node("opennav_docking", "docking"),
        node("nav2_behaviors", "behaviors"),
        node("twist_mux", "mux"),
        node("nav2_lifecycle_manager", "manager", managed),
        node("my_nav", "dodge", ", remappings=[('out', '/base/cmd_vel_raw')]"),
        node("my_nav", "reach", ", parameters=[{'output': 'arm/joint_trajectory'}]"),
        node("tf2_ros", "frames"),
        node("nav2_planner", "planner"),
        node("my_nav", "detector", ", remappings=[('image', '/camera/image')]"),
    )
    assert names(app["cloud"]) == {"planner", "detector"}
    assert len(app["robot"]) == 10
    assert app["connectivity"] == {"link": "zenoh"}
    text = shell.read("app.yaml")
    for reason in (
        "it writes velocities or stops the robot",
        "it starts and stops monitor",
        "it uses /base/cmd_vel_raw, by which the robot moves",
    ):
        assert f"proposed for the robot, because {reason}" in text
    assert "FS560" not in shell("validate", "app.yaml").err


def test_a_container_is_split_where_some_of_it_moves_the_robot(shell: Shell) -> None:
    part = "ComposableNode(package={0!r}, plugin='{0}::Server', name={1!r})".format
    parts = [part("nav2_controller", "controller"), part("nav2_planner", "planner"), part("nav2_amcl", "amcl")]
    app, said = imported(
        shell,
        "Node(package='rclcpp_components', executable='component_container', name='nav2_container')",
        f"LoadComposableNodes(target_container='/nav2_container', composable_node_descriptions=[{', '.join(parts)}])",
    )
    (cloud,), (robot,) = app["cloud"], app["robot"]
    assert (robot["name"], names(robot["composable_node_descriptions"])) == ("nav2_container", {"controller"})
    assert (cloud["name"], names(cloud["composable_node_descriptions"])) == (
        "nav2_container_cloud",
        {"planner", "amcl"},
    )
    assert "nav2_container is split: controller must stay on the robot" in said
    assert "FS560" not in shell("validate", "app.yaml").err


def test_a_launch_file_without_a_candidate_has_an_error_in_place_of_a_cloud(shell: Shell) -> None:
    four = [("usb_cam", "cam"), ("rviz2", "rviz"), ("controller_manager", "control"), ("tf2_ros", "frames")]
    app, said = imported(shell, *(node(*one) for one in four), code=1)
    assert "each of its 4 nodes drives, shows, simulates or controls the robot: none is worth a cloud machine" in said
    assert (app["cloud"], names(app["robot"])) == ([], {"cam", "rviz", "control", "frames"})
    line = 1 + shell.read("app.yaml").splitlines().index(
        next(one for one in shell.read("app.yaml").splitlines() if "cloud: []" in one)
    )
    for shown in (said, shell("validate", "app.yaml", code=1).err):
        assert "error[FS306]: spec.cloud must have at least 1 entry" in shown
        assert f"--> app.yaml:{line}:3" in shown
        assert "include the launch file that starts perception or planning, or run init --from-graph" in shown


@pytest.mark.parametrize(
    ("parts", "warned"),
    [
        ({}, True),
        ({"connectivity": "{link: none}"}, True),
        ({"connectivity": "{link: zenoh}"}, False),
        ({"infra": "[slurm]"}, False),
        ({"robot": "[]"}, False),
    ],
)
def test_robot_nodes_and_a_rented_machine_without_a_link_are_a_warning(
    shell: Shell, parts: dict[str, str], warned: bool
) -> None:
    shell.write("specs/work.py", "")
    both = {
        "robot": "[{package: a, executable: b}]",
        "ros": "{distro: humble}",
        "probe": TOPICS,
        "benchmark": WORKLOAD,
    } | parts
    shell.write("specs/demo.yaml", spec(**both))
    said = shell("validate", "specs/demo.yaml").err
    assert ("warning[FS561]: spec.robot has nodes" in said) is warned
    if warned:
        block = said.partition("write '")[2].partition("'")[0]
        both.pop("connectivity", None)
        shell.write("specs/demo.yaml", spec(**both) + f"  {block}\n")
        assert "FS561" not in shell("validate", "specs/demo.yaml").err


@pytest.mark.parametrize("allowed", [False, True])
def test_without_an_allowance_the_latency_is_named_computing_only(shell: Shell, allowed: bool) -> None:
    limits = (
        "{latency: 10s, cost: $1/request, network_allowance: 30ms}" if allowed else "{latency: 10s, cost: $1/request}"
    )
    project(shell, constraints=limits)
    measure(shell)
    card = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv").out
    status = shell("status", "specs/demo.yaml").out
    manifest = YAML(typ="safe", pure=True).load(shell.read("compiled/demo/manifest.yaml"))
    words = "computing only, network allowance 0 s"
    assert [words in one for one in (card, status)] == [not allowed] * 2
    assert manifest["expected"]["latency"]["network_allowance"] == ("30ms" if allowed else "0s")
    shell("check", "demo")


def test_a_node_seen_to_publish_velocities_stays_on_the_robot(shell: Shell) -> None:
    seen = json.loads((Path(__file__).parents[1] / "cases" / "graph" / "robot.json").read_text("utf-8"))
    shell.write("robot.json", json.dumps(seen))
    shell("init", "before.yaml", "--observed", "robot.json")
    before = YAML(typ="safe", pure=True).load(shell.read("before.yaml"))["spec"]
    response = before["probe"]["response"]
    seen["topics"]["/base/cmd_vel"] = seen["topics"].pop(response)
    shell.write("robot.json", json.dumps(seen).replace(f'"{response}"', '"/base/cmd_vel"'))
    said = shell("init", "after.yaml", "--observed", "robot.json")
    assert "robot: /arm/detector, 0.40 cores: uses /base/cmd_vel, by which the robot moves" in said.out
    assert "note: no request and response were found of a node that can leave the robot" in said.err
    after = YAML(typ="safe", pure=True).load(shell.read("after.yaml"))["spec"]
    for one in before["cloud"]:
        assert one.get("executable") not in {other.get("executable") for other in after["cloud"]}
    assert before["ros"]["distro"] == after["ros"]["distro"]
    assert before["connectivity"] == {"link": "zenoh"}
