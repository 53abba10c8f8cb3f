"""Managed nodes with `autostart` are configured and activated in a sample, in a deployment and on the robot alike."""

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fogspec.base.layout import Layout
from fogspec.compile.agent_archive import agent_archive
from fogspec.compile.launch_files import robot_launch
from tests.ros.benching import NODES, bench
from tests.ros.namespaces import PYTHON, Net
from tests.ros.test_bench import recorded
from tests.support.agent import AGENT
from tests.unit.compile.test_tasks import application

CHANGE = """\
import rclpy, sys
from lifecycle_msgs.srv import ChangeState
rclpy.init()
node = rclpy.create_node("by_hand")
client = node.create_client(ChangeState, "/arm/planner/change_state")
client.wait_for_service()
request = ChangeState.Request()
request.transition.id = int(sys.argv[1])
future = client.call_async(request)
rclpy.spin_until_future_complete(node, future)
sys.exit(not future.result().success)
"""
UP = ["/arm/planner configured", "/arm/planner active"]
DEACTIVATE, LONG_S = "4", 600.0


def installed(net: Net, *words: str) -> dict[str, Any]:
    """The node as colcon installs it, and as a spec has it."""
    program = net.folder / "lib" / "own" / "planner"
    program.parent.mkdir(parents=True)
    program.write_text(f"#!{PYTHON}\n{(NODES / 'managed.py').read_text()}")
    program.chmod(0o755)
    return {
        "package": "own", "executable": "planner", "name": "planner", "namespace": "/arm", "launch": {"autostart": True},
        "arguments": [str(net.folder / "seen"), *words],
    }  # fmt: skip


def seen(net: Net) -> list[str]:
    path = net.folder / "seen"
    return path.read_text().splitlines() if path.exists() else []


def wait(holds: Callable[[], bool]) -> None:
    until_s = time.monotonic() + LONG_S
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.05)


def start(net: Net, *words: str) -> Any:
    said = [str(NODES / "managed.py"), str(net.folder / "seen"), *words]
    return net.python("planner", *said, "--ros-args", "-r", "__ns:=/arm")


def test_it_is_activated_each_time_that_it_starts_and_left_alone_otherwise(net: Net) -> None:
    activates = net.python("activate", str(AGENT), "activate", "--of", "/arm/planner", "--of", "/never/there")
    first = start(net)
    wait(lambda: seen(net) == UP)
    assert net.run([str(PYTHON), "-c", CHANGE, DEACTIVATE], LONG_S).returncode == 0
    time.sleep(3)  # longer than between two looks: nothing is to happen
    assert seen(net) == [*UP, "/arm/planner inactive"]
    first.popen.send_signal(signal.SIGKILL)
    first.popen.wait(LONG_S)
    start(net, "--fails", "2")
    wait(lambda: seen(net)[3:] == ["/arm/planner failed"] * 2 + UP)
    wait(lambda: activates.said().endswith("/arm/planner is activated\n"))
    assert activates.said().count("/arm/planner could not be configured: its own output may say why\n") == 2
    assert activates.stop() == 0


def test_a_managed_node_is_measured_from_its_first_request(net: Net) -> None:
    spec = {
        "cloud": [installed(net, "--slow", "2")], "probe": {"request": "/imu", "response": "/pose"},
        "benchmark": {"workload": {"bag": recorded(net)}, "ready_timeout": "600s"},
    }  # fmt: skip
    sample, _ = bench(net, spec, AMENT_PREFIX_PATH=str(net.folder))
    assert (sample["state"], sample["requests"] >= 25) == ("ok", True), sample
    assert seen(net) == UP  # nothing was lost


def test_the_robot_s_launch_file_activates_it_too(net: Net, tmp_path: Path) -> None:
    layout = Layout.of(tmp_path / "specs" / "own.yaml", "own")
    layout.robot.parent.mkdir(parents=True)
    layout.spec.parent.mkdir()
    layout.agent.write_bytes(agent_archive())
    content = robot_launch(application(robot=[installed(net)], ros={}), layout)
    assert content is not None
    layout.robot.write_bytes(content)
    played = net.start("robot", ["ros2", "launch", str(layout.robot)], AMENT_PREFIX_PATH=str(net.folder))
    wait(lambda: seen(net) == UP)
    played.stop()
