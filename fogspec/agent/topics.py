"""Listens to topics of unmodified nodes, like any other subscriber: requests and responses, goals of an action, metrics.

    python3 -m fogspec_machine.topics --request /image --response /poses --match stamp --success 'len(poses) > 0'
    python3 -m fogspec_machine.topics --action /navigate_to_pose
    python3 -m fogspec_machine.topics --metric path_length=/plan/result:path_cost

It runs on the measured machine, inside its ROS 2 environment, beside the nodes: standard library and rclpy. Messages are
deserialised only where a condition or a metric looks into them; with `stamp` both types must begin with a std_msgs/Header.
An action is watched on its status topic by the UUIDs of its goals: latency is from acceptance to success.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

from .pairing import HEADER, Pairing, stamp_of
from .records import Condition, Done, Stamp, Writer, field_of
from .ros import hearing, message_of, need_rclpy

DISCOVERY_S = 0.2
# As long as DDS may take until both sides know of each other: what is missed until then would shift the order of the rest.
SETTLE_S = 3.5
PATIENCE_S = 3.0
ENDS = {4: None, 5: "the goal was canceled", 6: "the goal was aborted"}  # action_msgs/msg/GoalStatus


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The options; exits with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="topics", allow_abbrev=False)
    parser.add_argument("--request")
    parser.add_argument("--response")
    parser.add_argument("--match", choices=("stamp", "order", "first_request", "last_response"), default="stamp")
    parser.add_argument("--action")
    parser.add_argument("--success", type=Condition.parse)
    parser.add_argument("--timeout", type=float)
    parser.add_argument("--metric", action="append", default=[], help="NAME=TOPIC:FIELD")
    options = parser.parse_args(arguments)
    if (options.request is None) != (options.response is None):
        parser.error("--request and --response belong together")
    return options


class Listener:
    """Subscribes to each topic as soon as somebody publishes it, and tells which ones nobody does."""

    def __init__(self, node: Any, writer: Writer) -> None:
        self.node, self.writer = node, writer
        self.missing: dict[str, Callable[[Any, bool], Callable[[bytes], None]]] = {}
        self.begun = time.monotonic()
        self.complete_s = float("inf")
        self.told: list[str] = []

    def want(self, topic: str, make: Callable[[Any, bool], Callable[[bytes], None]]) -> None:
        """`make(message_type, has_header)` gives what is called with each serialised message."""
        self.missing[topic] = make

    def look(self) -> None:
        """Subscribe to what has appeared."""
        if not self.missing:
            return
        known = dict(self.node.get_topic_names_and_types())
        for topic in [topic for topic in self.missing if known.get(topic)]:
            if len(known[topic]) > 1:
                sys.exit(f"{topic} is published with more than one type: {', '.join(known[topic])}")
            message_type, has_header = message_of(known[topic][0])
            received = self.missing.pop(topic)(message_type, has_header)
            self.node.create_subscription(message_type, topic, received, hearing(), raw=True)
        if not self.missing:
            self.complete_s = time.monotonic()
        elif [*self.missing] != self.told and time.monotonic() - self.begun > PATIENCE_S:
            self.told = [*self.missing]
            self.writer.line({"note": f"nobody publishes {', '.join(self.told)}"})


class Latencies:
    """Times the requests on two topics."""

    def __init__(self, listener: Listener, options: argparse.Namespace, writer: Writer) -> None:
        self.listener, self.options, self.writer = listener, options, writer
        self.pairing, self.warn_at, self.patience_s = Pairing(options.match, options.timeout), 10, PATIENCE_S
        listener.want(options.request, self._requests)
        listener.want(options.response, self._responses)

    def _requests(self, message_type: Any, has_header: bool) -> Callable[[bytes], None]:
        self._check(self.options.request, message_type, has_header)

        def received(message: bytes) -> None:
            now_s = time.monotonic()
            if self._settled(now_s):
                self._lose(self.pairing.take_request(self._stamp(message), now_s))

        return received

    def _responses(self, message_type: Any, has_header: bool) -> Callable[[bytes], None]:
        self._check(self.options.response, message_type, has_header)

        def received(message: bytes) -> None:
            now_s = time.monotonic()
            if not self._settled(now_s):
                return
            done = self.pairing.take_response(self._stamp(message), now_s)
            if done is None:
                self.writer.unmatched(now_s)
            else:
                self.writer.request(done, failure(self.options.success, message, message_type))

        return received

    def look(self, now_s: float) -> None:
        """What is lost by now, and what should be known of the figures."""
        pairing, options = self.pairing, self.options
        self._lose(pairing.expire(now_s))
        if pairing.answered >= self.warn_at:
            self.warn_at = 2 * pairing.answered
            self.writer.warning(pairing.warning())
        elif not pairing.answered and now_s - self.listener.complete_s > self.patience_s:
            self.patience_s *= 2
            heard = f"{pairing.count} requests" if pairing.count else "no request"
            self.writer.line({"note": f"{heard} on {options.request}, no response to them on {options.response}"})

    def _settled(self, now_s: float) -> bool:
        return self.options.match == "stamp" or now_s - self.listener.complete_s > SETTLE_S

    def _stamp(self, message: bytes) -> Stamp | None:
        return stamp_of(message) if self.options.match == "stamp" else None

    def _lose(self, lost: list[Done]) -> None:
        for one in lost:
            self.writer.request(one)

    def _check(self, topic: str, message_type: Any, has_header: bool) -> None:
        if self.options.match == "stamp" and not has_header:
            kind = f"{message_type.__module__.partition('.')[0]}/{message_type.__name__}"
            sys.exit(f"{topic} carries {kind}, which does not begin with a {HEADER}: match by order instead")


def failure(condition: Condition | None, message: bytes, message_type: Any) -> str | None:
    """Why a response does not count; ends the process when its type does not have the field."""
    if condition is None:
        return None
    from rclpy.serialization import deserialize_message

    try:
        return condition.failure(deserialize_message(message, message_type))
    except ValueError as problem:
        sys.exit(str(problem))


def goals(listener: Listener, action: str, writer: Writer) -> None:
    """Times the goals of an action, by UUID."""
    begun: dict[bytes, float] = {}
    ended: dict[bytes, None] = {}
    departed_s = float("-inf")

    def received_as(message_type: Any, _has_header: bool) -> Callable[[bytes], None]:
        from rclpy.serialization import deserialize_message

        def received(message: bytes) -> None:
            nonlocal departed_s
            now_s = time.monotonic()
            for one in deserialize_message(message, message_type).status_list:
                goal = bytes(one.goal_info.goal_id.uuid)
                if goal in ended:
                    continue
                start_s = begun.setdefault(goal, now_s)
                if one.status in ENDS:
                    ended[goal] = None
                    del begun[goal]
                    if start_s == now_s:
                        continue  # its beginning was not heard
                    done = Done(start_s, now_s - start_s, now_s - max(start_s, departed_s))
                    departed_s = now_s
                    writer.request(done, ENDS[one.status])

        return received

    listener.want(f"{action}/_action/status", received_as)


def metrics(listener: Listener, wanted: list[str], writer: Writer) -> None:
    """Tells values of topics' fields."""
    by_topic: dict[str, dict[str, str]] = {}
    for text in wanted:
        name, _, rest = text.partition("=")
        topic, _, path = rest.partition(":")
        by_topic.setdefault(topic, {})[name] = path

    def received_as(paths: dict[str, str]) -> Callable[[Any, bool], Callable[[bytes], None]]:
        def make(message_type: Any, has_header: bool) -> Callable[[bytes], None]:
            from rclpy.serialization import deserialize_message

            def received(raw: bytes) -> None:
                now_s = time.monotonic()
                message = deserialize_message(raw, message_type)
                try:
                    values = {name: float(field_of(message, path)) for name, path in paths.items()}
                except (TypeError, ValueError) as problem:
                    sys.exit(f"a metric cannot be read: {problem}")
                writer.metric(values, now_s, stamp_of(raw) if has_header else None)

            return received

        return make

    for topic, paths in by_topic.items():
        # The response's own topic may carry a metric as well.
        if topic in listener.missing:
            listener.want(topic, both(listener.missing[topic], received_as(paths)))
        else:
            listener.want(topic, received_as(paths))


def both(one: Callable[..., Any], other: Callable[..., Any]) -> Callable[[Any, bool], Callable[[bytes], None]]:
    """What makes a receiver that calls both, `one` first: it is the one that takes the time."""

    def make(message_type: Any, has_header: bool) -> Callable[[bytes], None]:
        first, second = one(message_type, has_header), other(message_type, has_header)

        def received(message: bytes) -> None:
            first(message)
            second(message)

        return received

    return make


def main() -> None:
    """Listen until interrupted."""
    options = parse()
    need_rclpy("topics")
    import rclpy
    from rclpy.executors import ExternalShutdownException

    rclpy.init()
    node = rclpy.create_node("fogspec_topics")
    writer = Writer(options.response or options.action or "metrics")
    listener = Listener(node, writer)
    timed = None if options.request is None else Latencies(listener, options, writer)
    if options.action is not None:
        goals(listener, options.action, writer)
    metrics(listener, options.metric, writer)
    looked_s = float("-inf")
    try:
        while rclpy.ok():
            rclpy.spin_once(node, timeout_sec=DISCOVERY_S)
            if time.monotonic() - looked_s >= DISCOVERY_S:
                looked_s = time.monotonic()
                listener.look()
                if timed is not None:
                    timed.look(looked_s)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
