"""A spec from a robot that runs, on simulated observations, and on runs of real nodes that were kept (tests/ros/graphs.py)."""

import json
import random
from pathlib import Path
from typing import Any

import pytest

from fogspec.importers.graph.observed import Observed
from fogspec.importers.graph.pairs import Pair, find_pairs
from fogspec.importers.graph.proposal import propose
from tests.ros.graphs import GRAPHS, recorded, score
from tests.support.running import Shell, shell  # noqa: F401

BEGUN = 1_795_000_000_000_000_000
S = 10**9


class Robot:
    """Observations of nodes that are simulated: times in seconds, with jitter."""

    def __init__(self, seed: int = 1) -> None:
        self.dice = random.Random(seed)
        self.topics: dict[str, dict[str, Any]] = {}
        self.nodes: dict[str, dict[str, Any]] = {}
        self.more: dict[str, Any] = {}

    def timer(
        self, node: str, topic: str, rate: float, count: int = 150, jitter: float = 2e-4, **more: Any
    ) -> list[float]:
        at = [(i + 0.3) / rate + self.dice.gauss(0, jitter) for i in range(count)]
        self.says(node, topic, [(t, t) for t in at], **more)
        return at

    def answers(
        self, node: str, request: str, response: str, busy: float, spread: float = 0.01, loss: float = 0.0,
        stamp: str = "kept", **more: Any,
    ) -> None:  # fmt: skip
        """A node with one thread: requests wait for it."""
        self.hears(node, request)
        free, said = 0.0, []
        for at, stamped, _ in self.topics[request]["messages"]:
            if self.dice.random() < loss:
                continue
            asked = (at - BEGUN) / S
            free = max(asked + 2e-4, free) + busy * (1 + self.dice.uniform(-spread, spread))
            said.append((free, ((stamped or at) - BEGUN) / S if stamp == "kept" else free))
        self.says(node, response, said, has_header=stamp != "none", **more)

    def says(self, node: str, topic: str, said: list[tuple[float, float]], size: int = 1000, **more: Any) -> None:
        header = more.pop("has_header", True)
        messages = [
            [BEGUN + round(at * S), BEGUN + round(stamp * S) if header else None, size] for at, stamp in sorted(said)
        ]
        self.nodes.setdefault(node, {})
        self.topics[topic] = {
            "types": ["x/msg/Y"], "publishers": [node], "subscribers": [], "has_header": header, "watched": True,
            "count": len(messages), "bytes": size * len(messages), "messages": messages, **more,
        }  # fmt: skip

    def hears(self, node: str, *topics: str) -> None:
        self.nodes.setdefault(node, {})
        for topic in topics:
            self.topics[topic]["subscribers"].append(node)

    def data(self) -> dict[str, Any]:
        return {"version": 1, "seconds": 15.0, "nodes": self.nodes, "topics": self.topics, **self.more}

    def seen(self) -> Observed:
        return Observed.model_validate(self.data())

    def pairs(self) -> list[Pair]:
        return find_pairs(self.seen())


@pytest.mark.parametrize(("stamp", "match"), [("kept", "stamp"), ("new", "order"), ("none", "order")])
def test_a_node_that_answers_is_found_with_its_latency(stamp: str, match: str) -> None:
    robot = Robot()
    robot.timer("/camera", "/rgb", 10)
    robot.answers("/detector", "/rgb", "/pose", 0.04, stamp=stamp)
    (pair,) = robot.pairs()
    assert (pair.node, pair.request, pair.response, pair.match) == ("/detector", "/rgb", "/pose", match)
    assert pair.p50_s == pytest.approx(0.0402, rel=0.01)
    assert pair.answered >= pair.requests - 1 >= 148


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("phase", ["same jitter", "none", "more"])
def test_a_timer_of_the_same_rate_answers_nothing(seed: int, phase: str) -> None:
    robot = Robot(seed)
    robot.timer("/camera", "/rgb", 10, jitter=3e-4)
    robot.timer("/beat", "/status", 10, jitter={"same jitter": 3e-4, "none": 1e-7, "more": 9e-4}[phase])
    robot.hears("/beat", "/rgb")
    assert robot.pairs() == []


def test_requests_that_are_lost_keep_a_stamped_pair_and_leave_an_unstamped_one_without_a_match() -> None:
    robot = Robot()
    robot.timer("/camera", "/rgb", 10)
    robot.answers("/detector", "/rgb", "/pose", 0.04, loss=0.15)
    robot.answers("/counter", "/rgb", "/count", 0.03, loss=0.15, stamp="none")
    stamped, counted = robot.pairs()
    assert (stamped.match, counted.match) == ("stamp", None)
    assert stamped.answered / stamped.requests == pytest.approx(0.85, abs=0.08)
    assert any("no stamp tells" in one for one in propose(robot.seen()).warnings)


def test_a_saturated_node_is_matched_by_stamp_although_requests_wait() -> None:
    robot = Robot()
    robot.timer("/camera", "/rgb", 20, count=100)
    robot.answers("/detector", "/rgb", "/pose", 0.06)
    (pair,) = robot.pairs()
    assert pair.match == "stamp"
    assert pair.p50_s > 0.3


def test_of_several_inputs_the_one_that_starts_the_work_is_the_request() -> None:
    robot = Robot()
    robot.timer("/camera", "/rgb", 10, size=900_000)
    robot.says(
        "/camera",
        "/camera_info",
        [((t - BEGUN) / S + 1e-4, (s - BEGUN) / S) for t, s, _ in robot.topics["/rgb"]["messages"]],
    )
    robot.timer("/imu", "/imu", 100, count=1500)
    robot.answers("/detector", "/rgb", "/boxes", 0.03)
    robot.answers("/tracker", "/boxes", "/track", 0.01)
    robot.hears("/detector", "/camera_info", "/imu")
    robot.hears("/tracker", "/rgb")
    found = {(one.node, one.request, one.response) for one in robot.pairs()}
    assert found == {("/detector", "/rgb", "/boxes"), ("/tracker", "/boxes", "/track")}


def test_a_topic_of_a_higher_rate_explains_nothing_although_it_always_comes_shortly_before() -> None:
    robot = Robot()
    robot.timer("/imu", "/imu", 50, count=750, has_header=False)
    robot.timer("/camera", "/rgb", 10, has_header=False)
    robot.answers("/detector", "/rgb", "/pose", 0.05, spread=0.005, stamp="none")
    robot.hears("/detector", "/imu")
    assert [(one.request, one.response) for one in robot.pairs()] == [("/rgb", "/pose")]


@pytest.mark.parametrize("seed", range(4))
def test_work_that_varies_more_than_any_timer_is_matched_by_count_alone(seed: int) -> None:
    robot = Robot(seed)
    robot.timer("/user", "/goal", 5, count=75, has_header=False)
    robot.answers("/planner", "/goal", "/path", 0.1, spread=0.6, stamp="none")
    (pair,) = robot.pairs()
    assert (pair.request, pair.match) == ("/goal", "order")
    assert pair.p50_s == pytest.approx(0.1, rel=0.25)


def test_a_latched_topic_and_a_node_that_reads_what_it_writes_are_no_requests() -> None:
    robot = Robot()
    robot.timer("/maps", "/map", 1, count=15, latched=True)
    robot.timer("/node", "/a", 10)
    robot.answers("/node", "/a", "/b", 0.01)
    robot.hears("/node", "/map")
    assert robot.pairs() == []


@pytest.mark.slow
def test_of_six_hundred_topics_the_pairs_are_found_although_a_recorder_hears_them_all() -> None:
    robot = Robot()
    for i in range(300):
        robot.timer(f"/n{i}", f"/in{i}", 10, count=20)
        robot.answers(f"/w{i}", f"/in{i}", f"/out{i}", 0.01)
    robot.hears("/recorder", *robot.topics)
    robot.timer("/recorder", "/status", 1, count=15)
    pairs = robot.pairs()
    assert {(one.request, one.response) for one in pairs} >= {(f"/in{i}", f"/out{i}") for i in range(300)}
    proposal = propose(robot.seen())
    assert len(proposal.lines) < 40
    assert "probe" in proposal.spec


def full() -> Robot:
    robot = Robot()
    robot.timer("/camera", "/rgb", 10, size=90_000)
    robot.answers("/arm/detector", "/rgb", "/pose", 0.04, size=200)
    robot.hears("/arm/controller", "/pose")
    robot.nodes["/arm/detector"] = {
        "parameters": {"gain": 38.0, "use_sim_time": False, "qos_overrides./a.depth": 1, "token": "ghp_" + "a1B2" * 9,
                       "classes": ["cup", "can"], "limit": float("inf")},
        "process": {"argv": ["/opt/ros/jazzy/lib/det_ros/detector_node", "--ros-args"], "package": "det_ros",
                    "executable": "detector_node", "remappings": {"__node": "detector", "image": "/rgb"},
                    "cpu_s": 6.0, "memory_bytes": 2**30},
    }  # fmt: skip
    robot.nodes["/arm/controller"] = {
        "process": {"argv": ["x"], "package": "arm", "executable": "controller", "arguments": ["--fast"]}, "gone": False,
    }  # fmt: skip
    return robot


def test_the_spec_is_valid_and_has_what_was_seen(shell: Shell) -> None:
    shell.write("robot.json", json.dumps(full().data()))
    ended = shell("init", "arm", "--observed", "robot.json")
    assert "/rgb -> /pose: 150 of 150 by stamp, p50 40.2 ms, p95 40." in ended.out
    assert "parameter token of detector is left for you" in ended.err
    assert "ghp_" not in ended.out + ended.err + shell.read("specs/arm/arm.yaml")
    assert "not visible from here" in ended.err  # the camera
    shell("validate")
    written = shell.read("specs/arm/arm.yaml")
    for line in (
        "package: det_ros", "executable: detector_node", "name: detector", "namespace: /arm", "gain: 38.0",
        "classes: [cup, can]", "image: /rgb", "apt: [ros-jazzy-det-ros]", "request: /rgb", "network_allowance: 77ms",
        "latency: 120ms", '"--fast"', 'transfer: $', "# link: 900 kB/s to the cloud",
    ):  # fmt: skip
        assert line in written, line
    assert "qos_overrides" not in written
    assert shell("init", "arm", "--observed", "robot.json", code=2).err.startswith(
        "error: specs/arm/arm.yaml is there already"
    )


def test_the_cpu_use_of_a_node_that_came_late_is_unknown(shell: Shell) -> None:
    robot = full()
    robot.nodes["/arm/detector"]["late"] = True
    shell.write("robot.json", json.dumps(robot.data()))
    ended = shell("init", "arm", "--observed", "robot.json")
    assert "/arm/detector appeared while the robot was watched: for its CPU use and rates, watch again" in ended.err
    assert "0.40 cores" not in ended.out
    assert "/arm/detector" in ended.out


def test_a_machine_library_names_a_first_machine(shell: Shell) -> None:
    robot = full()
    robot.more["machine"] = {"cpu": "Intel Core i7", "arch": "x86_64", "vcpus": 8, "memory_gib": 16.0}
    shell.write("robot.json", json.dumps(robot.data()))
    ended = shell("init", "arm", "--observed", "robot.json")
    (line,) = [one for one in ended.out.splitlines() if one.startswith("first guess: ")]
    assert " in aws/us-east-1, $" in line
    assert line.endswith("Measuring decides")
    assert f"# {line}" in shell.read("specs/arm/arm.yaml")


def test_a_service_and_an_action_have_their_callers_and_times(shell: Shell) -> None:
    robot = full()
    robot.topics.clear()
    goals = [[BEGUN + i * S, BEGUN + i * S + S // 2, "succeeded"] for i in range(9)]
    robot.more["actions"] = {
        "/go": {"type": "a/action/Go", "servers": ["/arm/detector"], "callers": ["/ui"], "goals": goals}
    }
    robot.more["services"] = {"/plan": {"type": "a/srv/Plan", "servers": ["/arm/controller"], "callers": ["/ui"]}}
    shell.write("robot.json", json.dumps(robot.data()))
    ended = shell("init", "arm", "--observed", "robot.json")
    assert "/go: action, 9 of 9 goals ended, p50 500 ms" in ended.out
    assert "/plan: service of /arm/controller, called by /ui" in ended.out
    assert "action: /go" in shell.read("specs/arm/arm.yaml")
    shell("validate")
    robot.more.pop("actions")
    shell.write("robot.json", json.dumps(robot.data()))
    assert "not known yet" in shell("init", "arm2", "--observed", "robot.json").err
    assert "service: /plan" in shell.read("specs/arm2/arm2.yaml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[1]", "not observations of a robot"),
        (b'{"version": 1, "seconds": 1, "nodes": {"/a": {"parameters": 3}}, "topics": {}}', "nodes./a.parameters"),
        (
            b'{"version": 1, "seconds": 1, "nodes": {}, "topics": {}}',
            "no node of a robot is visible in ROS_DOMAIN_ID 0",
        ),
        (b'{"version": 9, "seconds": 1, "nodes": {}, "topics": {}}', "version 9 is of another fogspec"),
        (b'{"version": 1, "seconds": 1e999', "not observations of a robot"),
    ],
)
def test_other_files_are_refused_and_nothing_is_written(content: bytes, message: str, shell: Shell) -> None:
    (shell.folder / "robot.json").write_bytes(content)
    assert message in shell("init", "arm", "--observed", "robot.json", code=1).err
    assert [path.name for path in shell.folder.iterdir()] == ["robot.json"]


def test_a_file_that_is_not_there_is_said(shell: Shell) -> None:
    assert "robot.json: no such file or directory" in shell("init", "arm", "--observed", "robot.json", code=1).err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--from-graph", "--from-launch", "x.py"), "three sources"),
        (("--record", "5s"), "--record needs a robot that runs"),
        (("--from-graph", "--watch", "5"), "--watch"),
        (("--from-graph", "--watch", "2h"), "between 1 s and 10 min"),
    ],
)
def test_options_that_make_no_sense_together(words: tuple[str, ...], message: str, shell: Shell) -> None:
    assert message in shell("init", "arm", *words, code=2).err


def test_without_ros_2_it_says_how_and_writes_nothing(shell: Shell, tmp_path: Path) -> None:
    shell.monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    shell.monkeypatch.setenv("FOGSPEC_LOOKED_FOR_RCLPY", "1")
    ended = shell("init", "arm", "--from-graph", "--watch", "1s", code=1)
    assert "no python3 on PATH has rclpy" in ended.err
    assert "agent.pyz watch --out robot.json" in ended.err
    assert list(shell.folder.iterdir()) == []


RUNS = recorded()


def test_each_graph_has_a_run_that_was_kept() -> None:
    assert set(RUNS) == set(GRAPHS)


@pytest.mark.parametrize("name", GRAPHS)
def test_in_what_was_seen_of_real_nodes_the_pairs_that_exist_are_found_with_their_latencies(name: str) -> None:
    found = score(*RUNS[name], GRAPHS[name][1])
    assert (found.right, found.wrong) == (found.expected, set())
    assert max(map(abs, found.errors.values()), default=0.0) < 0.03


def works(robot: Robot, node: str, cpu_s: float, package: str = "arm", **more: Any) -> None:
    """Give a node a process of its own, with what it used in the 15 s of the watch."""
    argv = [f"/home/ws/install/{package}/lib/{package}/{node[1:]}"]
    process = {"argv": argv, "package": package, "executable": node[1:], "cpu_s": cpu_s, "memory_bytes": 2**29}
    robot.nodes[node] = {"process": {**process, **more}}


def pipeline() -> Robot:
    """A camera, three nodes on the way from its image to a path, and a recorder that hears all of it."""
    robot = Robot()
    robot.timer("/camera", "/raw", 10, size=500_000)
    robot.answers("/rectify", "/raw", "/rgb", 0.02, size=500_000)
    robot.answers("/detect", "/rgb", "/boxes", 0.05, size=300)
    robot.answers("/grasp", "/boxes", "/path", 0.02, size=900)
    robot.hears("/driver", "/path")
    robot.hears("/recorder", "/raw", "/rgb", "/boxes", "/path")
    for node, cpu_s, package in (("/camera", 6.0, "usb_cam"), ("/rectify", 3.0, "image_proc"), ("/detect", 7.5, "arm"),
                                 ("/grasp", 4.5, "arm"), ("/driver", 0.3, "arm"), ("/recorder", 9.0, "rosbag2")):  # fmt: skip
        works(robot, node, cpu_s, package)
    return robot


def test_the_nodes_that_work_on_the_way_of_a_request_go_together(shell: Shell) -> None:
    shell.write("robot.json", json.dumps(pipeline().data()))
    said = shell("init", "arm", "--observed", "robot.json").out
    written = shell.read("specs/arm/arm.yaml")
    for line in (
        "cloud: /detect, 0.50 cores, 0.50 GiB: answers /rgb",
        "cloud: /rectify, 0.20 cores, 0.50 GiB: on the way, /raw -> /rgb",
        "cloud: /grasp, 0.30 cores, 0.50 GiB: on the way, /boxes -> /path",
        "robot: /camera, 0.40 cores: drives a camera or depth sensor of the robot",
        "robot: /recorder, 0.60 cores: not on the way from a request to its response",
        "link: 5 MB/s to the cloud, most of it /raw, 5 MB/s",
    ):
        assert line in said.splitlines(), line
        assert f"# {line}" in written.splitlines(), line
    assert "/driver" not in said
    cloud, robot = written.partition("  robot:")[::2]
    assert [name for name in ("rectify", "detect", "grasp") if f"executable: {name}" in cloud] == [
        "rectify",
        "detect",
        "grasp",
    ]
    assert "executable: recorder" in robot
    assert ("request: /raw" in robot, "response: /path" in robot) == (True, True)
    for package in ("image_proc", "arm"):
        shell.write(f"specs/arm/ros2_ws/src/{package}/package.xml", f"<package><name>{package}</name></package>")
    shell("validate")


def test_a_node_that_works_little_or_whose_process_others_share_stays_and_ends_the_way() -> None:
    robot = pipeline()
    works(robot, "/rectify", 0.6, "image_proc")
    works(robot, "/grasp", 4.5, shared=True)
    proposal = propose(robot.seen())
    assert [node["executable"] for node in proposal.spec["cloud"]] == ["detect"]
    assert proposal.spec["probe"]["request"] == "/rgb"
    assert "robot: /rectify, 0.04 cores: works too little to gain by a larger machine" in proposal.lines
    assert "robot: /grasp: it shares its process with other nodes" in proposal.lines


def test_without_a_request_and_response_of_all_of_them_the_one_that_works_most_goes_alone() -> None:
    robot = pipeline()
    del robot.topics["/path"]
    robot.answers("/grasp", "/boxes", "/path", 0.02, loss=0.3, stamp="new")
    robot.hears("/driver", "/path")
    proposal = propose(robot.seen())
    assert [node["executable"] for node in proposal.spec["cloud"]] == ["detect"]
    assert (proposal.spec["probe"]["request"], proposal.spec["probe"]["response"]) == ("/rgb", "/boxes")


def test_what_stays_on_the_robot_is_not_what_works_most() -> None:
    robot = Robot()
    robot.timer("/encoders", "/joint_states", 50, count=750)
    robot.answers("/state", "/joint_states", "/tf", 0.018)
    robot.timer("/camera", "/rgb", 2, count=30)
    robot.answers("/detect", "/rgb", "/boxes", 0.05)
    works(robot, "/state", 12.0, "robot_state_publisher")
    works(robot, "/detect", 1.5)
    proposal = propose(robot.seen())
    assert [node["executable"] for node in proposal.spec["cloud"]] == ["detect"]
    assert any(line.startswith("robot: /state, 0.80 cores: publishes the robot's state") for line in proposal.lines)


def test_a_service_whose_calls_are_published_is_timed_and_one_that_it_calls_goes_with_it() -> None:
    robot = Robot()
    for node, cpu_s in (("/planner", 6.0), ("/costs", 3.0), ("/mission", 0.1)):
        works(robot, node, cpu_s)
    calls = [[BEGUN + i * S, BEGUN + i * S + (40 + i) * S // 1000] for i in range(15)]
    robot.more["services"] = {
        "/plan": {
            "type": "a/srv/P",
            "servers": ["/planner"],
            "callers": ["/mission"],
            "introspected": True,
            "calls": calls,
        },
        "/cost": {"type": "a/srv/C", "servers": ["/costs"], "callers": ["/planner"]},
        "/reset": {"type": "a/srv/R", "servers": ["/costs"], "callers": []},
        "/save": {"type": "a/srv/R", "servers": ["/costs"], "callers": ["/mission"], "introspected": True},
    }
    robot.more["actions"] = {"/go": {"type": "a/action/G", "servers": ["/mission"], "callers": ["/ui"]}}
    proposal = propose(robot.seen())
    assert proposal.spec["probe"] == {"service": "/plan", "timeout": "1s"}
    assert [node["executable"] for node in proposal.spec["cloud"]] == ["planner", "costs"]
    assert proposal.latency_s == pytest.approx(0.047)
    said = "\n".join(proposal.lines)
    assert "/plan: service, 15 of 15 calls answered, p50 47 ms, p95 54 ms, 1/s, called by /mission" in said
    assert "cloud: /costs, 0.20 cores, 0.50 GiB: on the way, service /cost for /planner" in said
    assert "/cost: service of /costs, called by /planner; its calls are not visible" in said
    assert "configure_introspection(clock, qos, METADATA) at its server shows them" in said
    assert "/save: service of /costs, called by /mission; no call was answered while it was watched" in said
    assert "/go: action of /mission, called by /ui; no goal began and ended while it was watched" in said
    assert "/reset" not in said
