"""Parameters that the spec sets are asked of real nodes: what a node does not declare is not measured as if it had it."""

import re
from pathlib import Path

import pytest

from tests.ros.benching import NODES, bench, fogspec, node
from tests.ros.namespaces import PYTHON, Net
from tests.support.agent import AGENT

DECLARES = NODES / "parameters.py"
ASKED = {
    ("declares", "wrok"): (3, "/declares declares no parameter wrok (there is work): ROS 2 ignores it"),
    ("my_robot/node", "work", "speed"): (3, "/declares declares no parameter speed: ROS 2 ignores it"),
    ("my_robot/node", "work", "use_sim_time"): (0, ""),
    ("/left/late", "work"): (0, ""),
    ("allows", "wrok"): (0, ""),
}


def installed(net: Net) -> Path:
    """The node as colcon installs it: which package and executable a process is, its path tells."""
    program = net.folder / "lib" / "my_robot" / "node"
    program.parent.mkdir(parents=True)
    program.write_text(f"#!{PYTHON}\n{DECLARES.read_text()}")
    program.chmod(0o755)
    return program


def test_nodes_are_found_by_name_or_process_and_late_ones_are_waited_for(net: Net) -> None:
    asking = [
        net.python(f"asks-{number}", str(AGENT), "declared", "--of", *words) for number, words in enumerate(ASKED)
    ]
    net.python("now", str(installed(net)), "now")
    net.python("late", str(DECLARES), "late", "--ros-args", "-r", "__node:=late", "-r", "__ns:=/left")
    net.python("allows", str(DECLARES), "allows", "--ros-args", "-r", "__node:=allows")
    for process, expected in zip(asking, ASKED.values(), strict=True):
        assert (process.popen.wait(600), process.said().strip()) == expected


@pytest.mark.parametrize(("name", "state"), [("wrok", "failed"), ("work", "ok")])
def test_a_parameter_that_no_node_declares_ends_the_sample_before_it_is_measured(
    net: Net, name: str, state: str
) -> None:
    installed(net)
    spec = {
        "cloud": [{"package": "my_robot", "executable": "node", "arguments": ["now"], "parameters": {name: 2}},
                  node("busy", "topic", 0.02, net.folder / "truth")],
        "probe": {"request": "/imu", "response": "/pose"},
        "benchmark": {"workload": {"node": node("client", "topic", 4000)}, "ready_timeout": "600s"},
    }  # fmt: skip
    sample, _ = bench(net, spec, AMENT_PREFIX_PATH=str(net.folder))
    assert sample["state"] == state, sample
    if state == "failed":
        assert sample["reason"] == "not_reported"
        assert sample["detail"] == "/declares declares no parameter wrok (there is work): ROS 2 ignores it"
        words = ["bench", "specs/robot.yaml", "--runner", "local", "--yes"]
        again = fogspec(net, words, AMENT_PREFIX_PATH=str(net.folder))
        assert re.search(r"fix: specs/robot.yaml:\d+:\d+: write work, or declare it in the node\n", again.stdout)
