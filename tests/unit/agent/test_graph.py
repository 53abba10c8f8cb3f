"""What makes a robot be looked at again, of what the middleware discovers in any order; tests/ros has the real one."""

from typing import Any

from fogspec.agent.graph import Graph


class Middleware:
    """A node that knows topics by name, with publishers and subscribers, and the names of nodes."""

    def __init__(self) -> None:
        self.topics: dict[str, list[list[str]]] = {"/rgb": [["camera"], []]}
        self.nodes = ["camera", "fogspec_watch"]

    def get_name(self) -> str:
        return "fogspec_watch"

    def get_namespace(self) -> str:
        return "/"

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(topic, ["sensor_msgs/msg/Image"]) for topic in self.topics]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        return [(name, "/") for name in self.nodes]

    def count_publishers(self, topic: str) -> int:
        return len(self.topics[topic][0])

    def count_subscribers(self, topic: str) -> int:
        return len(self.topics[topic][1])


def test_a_subscription_that_is_discovered_after_its_node_is_a_change() -> None:
    robot = Middleware()
    graph = Graph(robot)
    seen: list[Any] = [graph.names()]
    robot.nodes.append("worker")
    robot.topics["/pose"] = [["worker"], []]
    seen.append(graph.names())
    robot.topics["/rgb"][1].append("worker")
    seen.append(graph.names())
    assert seen[0] != seen[1] != seen[2] == graph.names()
