"""What a ROS graph shows of why a node is silent: a graph as rclpy describes it, without ROS."""

from types import SimpleNamespace
from typing import Any

import pytest

from fogspec.agent.causes import Managed, of_graph

RELIABLE, EFFORT, KEPT, VOLATILE = 1, 2, 1, 2


def end(name: str, kind: str = "A", reliability: int = RELIABLE, durability: int = VOLATILE) -> SimpleNamespace:
    quality = SimpleNamespace(reliability=reliability, durability=durability)
    return SimpleNamespace(node_name=name, node_namespace="/", topic_type=kind, qos_profile=quality)


class Graph:
    """A node of rclpy, as far as it is asked."""

    def __init__(self, **topics: tuple[list[SimpleNamespace], list[SimpleNamespace]]) -> None:
        self.topics = {f"/{name}": ends for name, ends in topics.items()}

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(name, ["A"]) for name in self.topics]

    def get_publishers_info_by_topic(self, topic: str) -> list[SimpleNamespace]:
        return self.topics[topic][0]

    def get_subscriptions_info_by_topic(self, topic: str) -> list[SimpleNamespace]:
        return self.topics[topic][1]


CLIENT, LISTENER, NODE = end("client"), end("fogspec_topics", reliability=EFFORT), end("planner")


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        ({"scan": ([CLIENT], [LISTENER, NODE])}, []),
        ({"scan": ([CLIENT], [LISTENER])}, ["no node subscribes to /scan"]),
        ({}, ["no node subscribes to /scan"]),
        ({"scan": ([CLIENT], [end("planner", "B")])}, ["/scan: A is published, /planner wants B"]),
        ({"scan": ([end("client", reliability=EFFORT)], [NODE])},
         ["/scan: offered best effort, requested reliable by /planner"]),
        ({"scan": ([end("client", reliability=EFFORT)], [end("planner", reliability=EFFORT)])}, []),
        ({"scan": ([CLIENT], [NODE]), "map": ([end("server")], [end("planner", durability=KEPT)])},
         ["/map: offered volatile, requested transient local by /planner"]),
        ({"scan": ([CLIENT, end("other", reliability=EFFORT)], [NODE])}, []),  # what one offers arrives
        ({"scan": ([end("client", reliability=0, durability=3)], [end("planner", durability=KEPT)])}, []),  # not known
        ({"scan": ([CLIENT], [NODE]), "map": ([], [NODE]), "tf": ([], [NODE])},
         ["planner listens to /map, which no node publishes"]),
    ],
)  # fmt: skip
def test_what_keeps_messages_from_a_node(topics: dict[str, Any], said: list[str]) -> None:
    assert list(of_graph(Graph(**topics), "/scan")) == said


def test_managed_nodes_that_are_not_active() -> None:
    found = Managed(Graph())
    for name, number, label in (("/b", 1, "unconfigured"), ("/a", 2, "inactive"), ("/c", 3, "active")):
        found.take(name, SimpleNamespace(current_state=SimpleNamespace(id=number, label=label)))
    found.take("/d", None)
    assert list(found.causes()) == ["/a is inactive: it was not activated", "/b is unconfigured: it was not activated"]
