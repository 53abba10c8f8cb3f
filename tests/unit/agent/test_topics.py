"""The listener's hint about a topic that is not published, and its count of what did not come."""

import json
from pathlib import Path

import pytest

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


@pytest.mark.parametrize(
    ("numbers", "heard", "sent"),
    [
        ([], 0, 0),
        ([7, 8, 9], 3, 3),
        ([7, 10, 60], 3, 54),
        ([7, 9, 1, 2, 4], 5, 7),  # another publisher: the old one ended
        ([None, -1, 0, 2**64 - 1, "7"], 0, 0),
    ],
)
def test_messages_that_did_not_come_are_counted_by_their_numbers(numbers: list[object], heard: int, sent: int) -> None:
    found = topics.Numbers()
    for one in numbers:
        found.take(one)
    assert (found.heard, found.sent) == (heard, sent)


def test_what_was_missed_is_written_while_one_node_publishes(tmp_path: Path) -> None:
    listener = topics.Listener(Graph(), Writer("metrics", str(tmp_path / "t")))
    for topic in ("/plan/result", "/odom2"):
        listener.numbers[topic] = topics.Numbers()
        for number in (1, 2, 5):
            listener.numbers[topic].take(number)
    listener.report_missed(["/plan/result", "/never"])
    listener.report_missed(["/plan/result"])
    written = {"missed": 2, "topic": "/plan/result", "sent": 5}
    assert [json.loads(one) for one in (tmp_path / "t").read_text().splitlines()] == [written]
    listener.node.count_publishers = lambda _topic: 2
    listener.numbers["/plan/result"].take(9)
    listener.report_missed(["/plan/result"])
    listener.node.count_publishers = lambda _topic: 1
    listener.report_missed(["/plan/result"])
    assert len((tmp_path / "t").read_text().splitlines()) == 1, "numbers of two say nothing"
