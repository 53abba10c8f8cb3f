"""`init --from-graph` beside real nodes; `python -m tests.ros.graphs` scores all graphs. About 40 s."""

import json
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.ros.benching import fogspec
from tests.ros.graphs import GRAPHS, NODES, observe, score, source, ticker, worker
from tests.ros.namespaces import PYTHON, Net, undisturbed
from tests.support.agent import AGENT


@undisturbed
def test_what_exists_is_found_among_decoys_and_nothing_else(net: Net) -> None:
    graph = [
        source("/raw", "image", 10),
        worker("/raw", "/rgb", 0.02, kind="image", stamp=False),
        worker("/rgb", "/pose", 0.04, loss=0.1, also={"/map": "image"}),
        {"node": "maps", "latched": [{"topic": "/map", "kind": "image"}]},
        ticker({"/rgb": "image"}, "/status", "text", 10),
        *GRAPHS["an action and a service"][0],
        {"node": "mapper", "serves": [{"service": "/grid", "busy": 0.05, "introspected": True}]},
        {"node": "asker", "calls": [{"service": "/grid", "every": 0.5}]},
    ]
    expected = {("/raw", "/rgb"), ("/rgb", "/pose"), ("/navigate", "/navigate"), ("/grid", "/grid")}
    seen, truth = observe(net, graph, 8.0)
    found = score(seen, truth, expected)
    # Pairs without a stamp are told by their order in time, which a busy machine disturbs: then they are not proposed.
    # Times are judged on the runs that are kept, by tests/unit/language/test_graph_import.py.
    assert found.wrong == set()
    assert found.right in (expected, expected - {("/raw", "/rgb")})
    assert {one.match for one in found.found} <= {"stamp", "order"}
    assert max(map(abs, found.errors.values())) < 0.5
    plan = seen.services["/plan"]
    assert (plan.servers, plan.callers, plan.introspected, plan.calls) == (["/planner"], ["/mission"], False, [])
    assert (seen.services["/grid"].introspected, seen.services["/grid"].callers) == (True, ["/asker"])


def test_from_a_robot_that_runs_to_a_spec_that_compiles(net: Net) -> None:
    program = net.folder / "install" / "my_robot" / "lib" / "my_robot" / "detector"
    program.parent.mkdir(parents=True)
    program.write_text((NODES / "graph.py").read_text())
    detector = {**worker("/image", "/pose", 0.05), "parameters": {"gain": 38.0, "password": "hunter2-Xy9"}}
    truth = str(net.folder / "truth")
    camera = net.python("camera", str(NODES / "graph.py"), json.dumps([source("/rgb", "image", 10)]), truth)
    net.start("detector", [str(PYTHON), str(program), json.dumps([detector]), truth,
                           "--ros-args", "-r", "/image:=/rgb"])  # fmt: skip
    # An answer needs both nodes; how long they take to start is the machine's affair.
    while not Path(truth).exists() or not Path(truth).stat().st_size:
        assert camera.popen.poll() is None, camera.said()
        time.sleep(0.1)
    made = fogspec(net, ["init", "arm", "--from-graph", "--watch", "5s", "--record", "3s"])
    assert made.returncode == 0, made.stderr
    assert "by stamp, p50 " in made.stdout
    written = (net.folder / "specs/arm/arm.yaml").read_text()
    for line in (
        "package: my_robot",
        "executable: detector",
        "gain: 38.0",
        "/image: /rgb",
        "request: /rgb",
        "bag: data/arm",
    ):
        assert line in written, line
    assert "hunter2" not in written + made.stdout + made.stderr
    package = net.folder / "specs/arm/ros2_ws/src/my_robot/package.xml"
    package.parent.mkdir(parents=True)
    package.write_text("<package><name>my_robot</name></package>")
    planned = fogspec(net, ["compile", "specs/arm/arm.yaml", "--catalog", "snapshot"])
    assert planned.returncode == 0, planned.stderr
    read = "import sys; from pathlib import Path; from fogspec.agent.bag import messages as of; "
    read += "print(len(list(of(Path(sys.argv[1])))))"
    count = net.run([sys.executable, "-c", read, str(net.folder / "specs/arm/data/arm")], 600, PYTHONPATH=str(ROOT))
    assert int(count.stdout) >= 5, count.stderr
    # The robot's camera goes away, and the rest of the robot with it.
    camera.stop()
    again = fogspec(net, ["init", "other", "--from-graph", "--watch", "3s", "--record", "2s"])
    assert "no request and response were found" in again.stderr
    assert not (net.folder / "specs/other/data").exists()


LOOKS = """\
import sys
sys.path.insert(0, sys.argv[1])
import rclpy
from fogspec_agent import watch
rclpy.init()
node = rclpy.create_node("looks")
robot = watch.Robot(watch.Graph(node), watch.Listener(node), watch.Observations())
heard = robot.heard.counts
while not heard.get("/rgb"):
    robot.look() and robot.listen()
    robot.listener.poll()
print("first", *robot.topics["/rgb"]["subscribers"], flush=True)
while not heard.get("/pose"):
    robot.look() and robot.listen()
    robot.listener.poll()
while "/worker_pose" not in robot.topics["/rgb"]["subscribers"]:
    robot.look()
print("then", *robot.topics["/pose"]["publishers"], robot.processes.of("/worker_pose")["argv"][1], flush=True)
"""


def test_a_node_that_starts_during_the_watch_is_seen(net: Net) -> None:
    program, truth = str(NODES / "graph.py"), str(net.folder / "truth")
    net.python("camera", program, json.dumps([source("/rgb", "image", 10)]), truth)
    looks = net.python("looks", "-c", LOOKS, str(AGENT))
    while looks.said() != "first\n":
        assert looks.popen.poll() is None, looks.said()
        time.sleep(0.1)
    net.python("late", program, json.dumps([worker("/rgb", "/pose", 0.01)]), truth)
    assert looks.popen.wait(1200) == 0, looks.said()
    assert looks.said() == f"first\nthen /worker_pose {program}\n"


@pytest.mark.parametrize("words", [("--watch", "2s")])
def test_without_a_robot_nothing_is_written(words: tuple[str, ...], net: Net) -> None:
    before = sorted(net.folder.iterdir())
    ended = fogspec(net, ["init", "arm", "--from-graph", *words])
    assert ended.returncode == 1
    assert "no node of a robot is visible" in ended.stderr
    assert [path for path in sorted(net.folder.iterdir()) if path not in before and path.name != "ros-log"] == []
