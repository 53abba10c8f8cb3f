"""Ask the nodes whether they have the parameters that the spec sets: ROS 2 ignores one that its node does not declare.

    python3 agent.pyz declared --of /arm/planner gain rate --of tracker depth --of visual_slam/slam features

A node is given by its full name, by its name in any namespace, or by package and executable of its process. It ends with 0
once all have theirs, and with `REFUSED` and a line that says what is missing once a node has answered for `PATIENCE_S` seconds
without declaring a parameter. Nodes that are not up, lifecycle nodes that are not configured and nodes that do not answer are
waited for. A node that allows parameters which it did not declare (`allow_undeclared_parameters`) has all of them.
"""

import argparse
import contextlib
import difflib
import sys
import time
from collections.abc import Sequence

from .graph import Answer, Graph, call, full_name, take_turns
from .robot_processes import Processes
from .ros import need_rclpy

REFUSED = 3
PATIENCE_S = 5.0  # some nodes declare their parameters after they can be asked
AGAIN_S = 0.5
CALL_S = 60.0  # a node that works on a request answers after it
GIVES_UP_S = 900.0
NOT_CONFIGURED = (0, 1, 10)  # lifecycle_msgs/msg/State: unknown, unconfigured, configuring


class Asked:
    """One node of the spec with the parameters that it is to have; `undeclared` is set once some are certainly missing."""

    def __init__(self, graph: Graph, key: str, names: Sequence[str]) -> None:
        self.graph, self.key, self.names = graph, key, names
        self.undeclared: str | None = None

    def asking(self) -> Answer[None]:
        """Ask until the node has all, or has not declared one for too long."""
        since_s: float | None = None
        while (found := (yield from self._missing())) != "":
            now_s = time.monotonic()
            since_s = None if found is None else now_s if since_s is None else since_s
            if since_s is not None and now_s - since_s >= PATIENCE_S:
                self.undeclared = found
                return
            while time.monotonic() - now_s < AGAIN_S:
                yield

    def _missing(self) -> Answer[str | None]:
        """Return what the node does not declare, empty if that is nothing; None if it is not known yet."""
        from rcl_interfaces.srv import GetParameters, ListParameters

        node, declared, left = self.graph.node, dict[str, list[str]](), list(self.names)
        for namespace, name in self._nodes():
            one, offers = full_name(namespace, name), dict[str, list[str]]()
            with contextlib.suppress(Exception):  # a node that has just ended has no entry
                offers = dict(node.get_service_names_and_types_by_node(name, namespace))
            if f"{one}/list_parameters" not in offers:
                continue
            if (yield from self._is_not_configured(one, offers)):
                return None
            answer = yield from call(node, ListParameters, f"{one}/list_parameters", ListParameters.Request(), CALL_S)
            if answer is None:
                return None
            declared[one] = list(answer.result.names)
            left = [name for name in left if name not in declared[one]]
        for one in declared:
            for name in list(left):
                request = GetParameters.Request(names=[name])
                answer = yield from call(node, GetParameters, f"{one}/get_parameters", request, CALL_S)
                # A value that is not set is one that may be: a node that does not allow it returns none.
                if answer is None:
                    return None
                if answer.values:
                    left.remove(name)
        return said(declared, left) if declared else None

    def _is_not_configured(self, node: str, offers: dict[str, list[str]]) -> Answer[bool]:
        if offers.get(f"{node}/get_state") != ["lifecycle_msgs/srv/GetState"]:
            return False
        try:
            from lifecycle_msgs.srv import GetState
        except ImportError:
            return True
        answer = yield from call(self.graph.node, GetState, f"{node}/get_state", GetState.Request(), CALL_S)
        return answer is None or answer.current_state.id in NOT_CONFIGURED

    def _nodes(self) -> list[tuple[str, str]]:
        nodes = self.graph.nodes()
        if self.key.startswith("/"):
            return [one for one in nodes if full_name(*one) == self.key]
        if "/" not in self.key:
            return [one for one in nodes if one[1] == self.key]
        started = processes(self.graph)
        return [one for one in nodes if started.get(full_name(*one)) == self.key]


def processes(graph: Graph) -> dict[str, str]:
    """Return package and executable of each node whose process is known."""
    publishers = graph.node.get_publishers_info_by_topic("/parameter_events")
    gids = {full_name(one.node_namespace, one.node_name): bytes(one.endpoint_gid) for one in publishers}
    known = Processes()
    known.add(gids, gids.pop(graph.own, b""))
    found = {node: known.of(node) for node in gids}
    return {node: f"{one['package']}/{one['executable']}" for node, one in found.items() if one is not None}


def said(declared: dict[str, list[str]], left: Sequence[str]) -> str:
    """Return that nodes do not declare the parameters that are left, each with the nearest name; empty for none."""
    known = sorted({name for names in declared.values() for name in names})
    near = {name: difflib.get_close_matches(name, known, 1) for name in left}
    named = ", ".join(f"{name} (there is {found[0]})" if found else name for name, found in near.items())
    verb = "declares" if len(declared) == 1 else "declare"
    return f"{', '.join(declared)} {verb} no parameter {named}: ROS 2 ignores it" if left else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Ask all; return 0 once all have their parameters, `REFUSED` once one has not, 1 if that stays unknown."""
    parser = argparse.ArgumentParser(prog="declared", allow_abbrev=False)
    parser.add_argument("--of", nargs="+", action="append", required=True, metavar="NODE PARAMETER")
    words = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(words)
    need_rclpy("declared", words)
    import rclpy

    rclpy.init()
    graph = Graph(rclpy.create_node("fogspec_declared", start_parameter_services=False, enable_rosout=False))
    asked = [Asked(graph, key, names) for key, *names in options.of]
    asking = [one.asking() for one in asked]
    until_s = time.monotonic() + GIVES_UP_S
    while asking and time.monotonic() < until_s and not any(one.undeclared for one in asked):
        asking = take_turns(graph.node, asking)
    found = [one.undeclared for one in asked if one.undeclared]
    print("; ".join(found) if found else "", flush=True)
    return REFUSED if found else 1 if asking else 0


if __name__ == "__main__":
    sys.exit(main())
