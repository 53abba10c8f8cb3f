"""Why nodes are silent, as far as their graph shows it: what state they are in, and what they offer and want."""

import importlib
from collections.abc import Iterator
from typing import Any

from .ros import RELIABLE

OWN = "fogspec_"  # what the names of this package's nodes begin with
STATE, ACTIVE = "lifecycle_msgs/srv/GetState", 3  # of lifecycle_msgs/msg/State
BEST_EFFORT = 2  # of rmw_qos_reliability_policy_t
KEPT, VOLATILE = 1, 2  # of rmw_qos_durability_policy_t: transient local
WITHOUT = ("/rosout", "/parameter_events", "/clock", "/tf", "/tf_static")  # silent in many a healthy graph


class Managed:
    """The states of nodes that a manager has to activate, requested without waiting."""

    def __init__(self, node: Any) -> None:
        self.node, self.clients, self.states = node, dict[str, Any](), dict[str, str]()

    def ask(self) -> None:
        """Ask all that there are; their answers come while the node spins."""
        for service, kinds in self.node.get_service_names_and_types():
            if STATE not in kinds:
                continue
            try:
                kind = importlib.import_module("lifecycle_msgs.srv").GetState
            except ImportError:
                return
            if service not in self.clients:
                self.clients[service] = self.node.create_client(kind, service)
            if self.clients[service].service_is_ready():
                name = service.rpartition("/")[0]
                self.clients[service].call_async(kind.Request()).add_done_callback(
                    lambda done, name=name: self.take(name, done.result())
                )

    def take(self, name: str, answer: Any) -> None:
        """Take a node's answer."""
        if answer is not None:
            state = answer.current_state
            self.states[name] = "" if state.id == ACTIVE else str(state.label)

    def all_active(self) -> bool:
        """Return whether all have answered that they are active."""
        return len(self.states) == len(self.clients) and not any(self.states.values())

    def causes(self) -> Iterator[str]:
        """Yield of each node that is not active what it is."""
        yield from (f"{name} is {state}: it was not activated" for name, state in sorted(self.states.items()) if state)


def of_graph(node: Any, request: str) -> Iterator[str]:
    """Yield what keeps messages from a node: no node that listens, other types, a quality that is not offered, no publisher."""
    topics = sorted(name for name, _ in node.get_topic_names_and_types())
    ends = {name: _ends(node, name) for name in topics}
    if not ends.get(request, ([], []))[1]:
        yield f"no node subscribes to {request}"
    for name, (offers, wants) in ends.items():
        for wanted in wants:
            whose = f"{wanted.node_namespace.rstrip('/')}/{wanted.node_name}"
            if not offers:
                continue
            if wanted.topic_type not in {one.topic_type for one in offers}:
                yield f"{name}: {offers[0].topic_type} is published, {whose} wants {wanted.topic_type}"
            elif all(short := [_short(one.qos_profile, wanted.qos_profile) for one in offers]):
                yield f"{name}: {short[0]} by {whose}"
    for name, (offers, wants) in ends.items():
        if wants and not offers and name not in WITHOUT and not name.endswith("/_action/cancel"):
            yield f"{wants[0].node_name} listens to {name}, which no node publishes"


def _ends(node: Any, topic: str) -> tuple[list[Any], list[Any]]:
    """Return who publishes and who subscribes to a topic, but this package's listeners."""
    wants = [one for one in node.get_subscriptions_info_by_topic(topic) if not one.node_name.startswith(OWN)]
    return list(node.get_publishers_info_by_topic(topic)), wants


def _short(offered: Any, requested: Any) -> str | None:
    """Return in which quality an offer is less than what is requested. docs.ros.org, "QoS compatibilities"."""
    if (int(requested.reliability), int(offered.reliability)) == (RELIABLE, BEST_EFFORT):
        return "offered best effort, requested reliable"
    if (int(requested.durability), int(offered.durability)) == (KEPT, VOLATILE):
        return "offered volatile, requested transient local"
    return None
