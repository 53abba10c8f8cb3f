"""What the middleware knows of a graph: nodes, topics, services, actions, and the nodes' parameters."""

import contextlib
import time
from collections.abc import Generator
from typing import Any, TypeVar

from .ros import offers_reliably

SETTLED_S, LATEST_S = 1.0, 8.0  # the graph is known once it has not changed for so long, or after this time
CALL_S = 3.0  # for all nodes' parameters
UNKNOWN = "_NODE_NAME_UNKNOWN_"  # of an endpoint that was discovered before its node
MOST_NODES = 200
MOST_PARAMETERS = 200
OF_EVERY_NODE = ("rcl_interfaces/", "type_description_interfaces/", "lifecycle_msgs/")
VALUES = ("", "bool_value", "integer_value", "double_value", "string_value", "", "bool_array_value",
          "integer_array_value", "double_array_value", "string_array_value")  # fmt: skip
END = object()
T = TypeVar("T")
Answer = Generator[None, None, T]  # what takes turns with others until it is known


def full_name(namespace: str, name: str) -> str:
    """Return the node's name in the graph."""
    return f"{namespace.rstrip('/')}/{name}"


class Graph:
    """What the middleware knows of nodes, topics, services and actions."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.own = full_name(node.get_namespace(), node.get_name())
        self.own_gid = b""
        self.gids: dict[str, bytes] = {}
        self.whole = True  # whether the nodes of all endpoints are known
        self.services: dict[str, Any] = {}
        self.actions: dict[str, Any] = {}

    def settle(self) -> None:
        """Wait until discovery brings nothing new."""
        begun_s = changed_s = time.monotonic()
        known: Any = None
        while (now_s := time.monotonic()) - changed_s < SETTLED_S and now_s - begun_s < LATEST_S:
            found = self.names()
            changed_s, known = (now_s, found) if found != known or not self.nodes() else (changed_s, known)
            time.sleep(0.1)

    def names(self) -> tuple[list[Any], list[Any]]:
        """Return all topics, each with how many publish and subscribe, and nodes: they change when one comes or goes.

        A node is often known before its subscription to a topic that was there before.
        """
        topics, node = sorted(self.node.get_topic_names_and_types()), self.node
        return [(*one, node.count_publishers(one[0]), node.count_subscribers(one[0])) for one in topics], self.nodes()

    def nodes(self) -> list[tuple[str, str]]:
        """Return namespaces and names of the visible nodes but this one and those of tools."""
        found = {(namespace, name) for name, namespace in self.node.get_node_names_and_namespaces()}
        return sorted(one for one in found if full_name(*one) != self.own and not one[1].startswith("_"))

    def topics(self) -> dict[str, dict[str, Any]]:
        """Return publishers and subscribers of each topic."""
        found, self.whole = {}, True
        for topic, kinds in sorted(self.node.get_topic_names_and_types()):
            publishers = self.node.get_publishers_info_by_topic(topic)
            subscribers = self.node.get_subscriptions_info_by_topic(topic)
            for one in publishers:
                name, gid = full_name(one.node_namespace, one.node_name), bytes(one.endpoint_gid)
                if name == self.own:
                    self.own_gid = gid
                self.gids.setdefault(name, gid)
            found[topic] = {
                "types": sorted(kinds),
                "publishers": self._names(publishers),
                "subscribers": self._names(subscribers),
                "reliable": offers_reliably(self.node, topic),
                "latched": any(int(one.qos_profile.durability) == 1 for one in publishers),
            }
        return found

    def _names(self, endpoints: list[Any]) -> list[str]:
        names = {full_name(one.node_namespace, one.node_name) for one in endpoints if one.node_name != UNKNOWN}
        self.whole = self.whole and all(one.node_name != UNKNOWN for one in endpoints)
        return sorted(names - {self.own})

    def find_offers(self) -> None:
        """Add services and actions by name, each with its type, servers and callers, to those that were there before."""
        from rclpy.action import get_action_client_names_and_types_by_node as of_caller
        from rclpy.action import get_action_server_names_and_types_by_node as of_server

        for namespace, name in self.nodes()[:MOST_NODES]:
            node, here = self.node, full_name(namespace, name)
            with contextlib.suppress(Exception):  # a node that has just ended has no entry
                self._offer(self.services, "servers", here, node.get_service_names_and_types_by_node(name, namespace))
                self._offer(self.services, "callers", here, node.get_client_names_and_types_by_node(name, namespace))
                self._offer(self.actions, "servers", here, of_server(node, name, namespace))
                self._offer(self.actions, "callers", here, of_caller(node, name, namespace))

    @staticmethod
    def _offer(found: dict[str, Any], role: str, node: str, names: list[tuple[str, list[str]]]) -> None:
        for name, kinds in names:
            if "/_action/" in name or kinds[0].startswith(OF_EVERY_NODE):
                continue
            entry = found.setdefault(name, {"type": kinds[0], "servers": [], "callers": []})
            if node not in entry[role]:
                entry[role].append(node)


def call(node: Any, service: Any, name: str, request: Any, within_s: float) -> Answer[Any]:
    """Call a service, one step for each turn; return its answer, None if there is none in time."""
    until_s, future, client = time.monotonic() + within_s, None, node.create_client(service, name)
    try:
        while time.monotonic() < until_s:
            if future is None and client.service_is_ready():
                future = client.call_async(request)
            elif future is not None and future.done():
                return future.result()
            yield
        return None
    finally:
        node.destroy_client(client)


def take_turns(node: Any, steps: "list[Answer[None]]") -> "list[Answer[None]]":
    """Take one step of each, and what comes from other nodes; return those that have not ended."""
    import rclpy

    rclpy.spin_once(node, timeout_sec=0.01)
    return [one for one in steps if next(one, END) is not END]


def parameters(node: Any, nodes: list[tuple[str, str]]) -> dict[str, dict[str, Any]]:
    """Return the parameters of the nodes that answer in time."""
    from rcl_interfaces.srv import GetParameters, ListParameters

    found: dict[str, dict[str, Any]] = {}

    def ask(name: str) -> Answer[None]:
        listed = yield from call(node, ListParameters, f"{name}/list_parameters", ListParameters.Request(), CALL_S)
        asked = sorted(listed.result.names)[:MOST_PARAMETERS] if listed else []
        request = GetParameters.Request(names=asked)
        got = (yield from call(node, GetParameters, f"{name}/get_parameters", request, CALL_S)) if asked else None
        values = zip(asked, map(plain, got.values), strict=False) if got else ()
        if got:
            found[name] = {key: value for key, value in values if value is not None}

    until_s, asking = time.monotonic() + CALL_S, [ask(full_name(*one)) for one in nodes[:MOST_NODES]]
    while asking and time.monotonic() < until_s:
        asking = take_turns(node, asking)
    return found


def plain(value: Any) -> Any:
    """Return the value of a rcl_interfaces/msg/ParameterValue as JSON has it; None for bytes and for one that is not set."""
    field = VALUES[value.type] if value.type < len(VALUES) else ""
    found: Any = getattr(value, field) if field else None
    return list(found) if field.endswith("array_value") else found
