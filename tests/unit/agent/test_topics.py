"""The listener's hint about a topic that is not published names one with nearly the same name."""

import json
from pathlib import Path

from fogspec.agent import topics
from fogspec.agent.records import Writer


class Graph:
    """A node of rclpy, as far as the listener asks it while nothing is published."""

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [("/plan/result", ["std_msgs/msg/Float64"]), ("/odom2", ["nav_msgs/msg/Odometry"])]

    def count_publishers(self, topic: str) -> int:
        return int(topic == "/plan/result")  # a node only subscribes to the other one


def test_a_topic_that_is_nearly_there_is_named(tmp_path: Path) -> None:
    listener = topics.Listener(Graph(), Writer("metrics", str(tmp_path / "t")))
    for name in ("/plan/reslt", "/odom"):
        listener.want(name, lambda _type, _header: lambda _message: None)
    listener.started_s -= topics.PATIENCE_S + 1
    listener.subscribe()
    [note] = (tmp_path / "t").read_text().splitlines()
    assert json.loads(note) == {
        "note": "no node publishes /plan/reslt (there is /plan/result), /odom", "misnamed": True,
    }  # fmt: skip
