"""A bag is played with what a robot records beside the requests: other topics' stamps, the clock, what is published once.

It has topics that cannot be played, too: one of a type that is not installed, one of an action.
"""

from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from tests.ros.benching import bench, node
from tests.ros.namespaces import Net
from tests.unit.agent.test_bag import IMU, STORE, header, imu

PATH, CLOCK, TEXT = "nav_msgs/msg/Path", "rosgraph_msgs/msg/Clock", "std_msgs/msg/String"
BATTERY, FEEDBACK = "acme_msgs/msg/Battery", "test_msgs/action/Fibonacci_FeedbackMessage"
TOPICS = {"request": "/imu", "response": "/pose"}
ZERO = QosTime(0, 0)


def quality(reliable: bool, latched: bool) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE, ZERO, ZERO, QosLiveliness.AUTOMATIC, ZERO, False,
    )  # fmt: skip


def frames(at_s: float) -> Any:
    """Two stamps in one message, the later one the request's; its own header says none, as /tf has none."""
    point = STORE.types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
    turn = STORE.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    pose = STORE.types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    stamped = STORE.types["geometry_msgs/msg/PoseStamped"]
    poses = [stamped(header=header(one), pose=pose) for one in (at_s - 0.04, at_s)]
    return STORE.types[PATH](header=header(0), poses=poses)


def drive(net: Net) -> str:
    """Twenty requests a tenth of a second apart, in the clock of a simulator that began at 0."""
    (net.folder / "specs").mkdir(exist_ok=True)
    types = get_types_from_msg("float32 volts\n", BATTERY) | get_types_from_msg("uint8[16] goal_id\n", FEEDBACK)
    STORE.register({name: one for name, one in types.items() if name not in STORE.types})
    with Writer(net.folder / "specs" / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        def topic(name: str, kind: str, reliable: bool = True, latched: bool = False) -> Any:
            qualities = [quality(reliable, latched)]
            return writer.add_connection(name, kind, typestore=STORE, offered_qos_profiles=qualities)

        def write(to: Any, at_s: float, kind: str, message: Any) -> None:
            writer.write(to, round(at_s * 1e9), STORE.serialize_cdr(message, kind))

        asked, moved = topic("/imu", IMU, reliable=False), topic("/frames", PATH)
        ticked, told = topic("/clock", CLOCK), topic("/map", TEXT, latched=True)
        battery, feedback = topic("/battery", BATTERY), topic("/count/_action/feedback", FEEDBACK)
        write(told, 0.5, TEXT, STORE.types[TEXT](data="all"))
        for at_s in (1 + i / 10 for i in range(20)):
            write(ticked, at_s, CLOCK, STORE.types[CLOCK](clock=header(at_s).stamp))
            write(battery, at_s, BATTERY, STORE.types[BATTERY](volts=24.0))
            write(feedback, at_s, FEEDBACK, STORE.types[FEEDBACK](goal_id=np.zeros(16, np.uint8)))
            write(moved, at_s, PATH, frames(at_s))
            writer.write(asked, round(at_s * 1e9), imu(at_s))
    return "drive"


@pytest.mark.parametrize("kind", ["frames", "timer", "map"])
def test_nodes_get_what_was_recorded_beside_the_requests(net: Net, kind: str) -> None:
    one = node("drive", kind)
    if kind == "timer":
        one["cmd"] += ["--ros-args", "-p", "use_sim_time:=true"]
    spec = {
        "cloud": [one], "probe": TOPICS,
        "benchmark": {"workload": {"bag": drive(net)}, "ready_timeout": "120s", "min_success_rate": "90%"},
    }  # fmt: skip
    sample, _ = bench(net, spec)
    assert (sample["state"], sample["requests"] >= 25) == ("ok", True), sample
    logs = [
        path.read_text("utf-8", "replace") for path in net.folder.glob(".fogspec/robot/attempts/*/out/process-*.log")
    ]
    assert [line for log in logs for line in log.splitlines() if "left out" in line] == [
        "left out, for their types are not here: /battery (acme_msgs/msg/Battery)"
    ]
