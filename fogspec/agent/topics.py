"""Subscribe to topics of unmodified nodes, and time requests and responses, goals of an action, and metrics.

    python3 agent.pyz topics --request /image --response /poses --match stamp --success 'len(poses) > 0'
    python3 agent.pyz topics --action /navigate_to_pose
    python3 agent.pyz topics --metric path_length=/plan/result:path_cost

With `--hold` the supervisor holds back what sends the requests before they count, and at the end (`fogspec_agent.holding`).

It runs on the measured machine in its ROS 2 environment, beside the nodes, with the standard library and rclpy. Messages
are deserialised only if a condition or a metric needs their fields; with `stamp` both types must begin with a
std_msgs/Header. Goals are identified by their UUIDs on the action's status topic: latency is from acceptance to success.
"""

import argparse
import difflib
import itertools
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from .causes import Managed, of_graph
from .holding import HELD, Held
from .matching import HEADER, Matcher, stamp_of
from .records import Condition, Done, Stamp, Writer, field_of
from .ros import listening_qos, message_of, need_rclpy, offered
from .stopping import mistyped

DISCOVERY_S = 0.2
# DDS discovery may take this long: a message missed before it is complete would shift the order of the rest.
SETTLE_S = 3.5
PATIENCE_S = 3.0
ENDS = {4: None, 5: "the goal was canceled", 6: "the goal was aborted"}  # action_msgs/msg/GoalStatus


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; exit with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="topics", allow_abbrev=False)
    parser.add_argument("--request")
    parser.add_argument("--response")
    parser.add_argument("--match", choices=("stamp", "order", "first_request", "last_response"), default="stamp")
    parser.add_argument("--hold", action="store_true", help="have the senders held; for --match order")
    parser.add_argument("--action")
    parser.add_argument("--success", type=Condition.parse)
    parser.add_argument("--timeout", type=float)
    parser.add_argument("--metric", action="append", default=[], help="NAME=TOPIC:FIELD")
    options = parser.parse_args(arguments)
    if (options.request is None) != (options.response is None):
        parser.error("--request and --response belong together")
    return options


class Numbers:
    """How many messages of one publisher came, and how many it sent from the first of them on."""

    def __init__(self) -> None:
        self.heard = self.sent = self.last = 0

    def take(self, number: Any) -> None:
        """Take the number of a message; a middleware that does not number them gives none, or the largest there is."""
        if isinstance(number, int) and 0 < number < 2**63:
            self.heard += 1
            self.sent += number - self.last if 0 < self.last < number else 1
            self.last = number


class Listener:
    """Subscribe to each topic as soon as it is known, and report those that are not published.

    Reliably, unless one publishes it with best effort: of large messages, a best-effort subscription gets few as a whole.
    """

    def __init__(self, node: Any, writer: Writer) -> None:
        self.node, self.writer = node, writer
        self.missing: dict[str, Callable[[Any, bool], Callable[[bytes], None]]] = {}
        self.subscriptions: dict[str, tuple[Any, bool, Callable[[bytes], None]]] = {}
        self.numbers: dict[str, Numbers] = {}
        self.missed: dict[str, int] = {}
        self.started_s = time.monotonic()
        self.complete_s = float("inf")
        self.managed, self.asked_s, self.reported = Managed(node), float("-inf"), ""

    def want(self, topic: str, make: Callable[[Any, bool], Callable[[bytes], None]]) -> None:
        """Subscribe later; `make(message_type, has_header)` returns the callback for each serialised message."""
        self.missing[topic] = make

    def subscribe(self) -> None:
        """Subscribe to the topics that are known now."""
        for topic, (subscription, reliable, received) in list(self.subscriptions.items()):
            # A publisher with best effort was discovered since: none of it was heard.
            if reliable and not all(offered(self.node, topic)):
                self.node.destroy_subscription(subscription)
                self._subscribe(topic, subscription.msg_type, received)
                self.complete_s = self.complete_s if self.missing else time.monotonic()
        if not self.missing:
            return
        known = dict(self.node.get_topic_names_and_types())
        for topic in [topic for topic in self.missing if known.get(topic)]:
            if len(known[topic]) > 1:
                sys.exit(f"{topic} is published with more than one type: {', '.join(known[topic])}")
            message_type, has_header = message_of(known[topic][0])
            received = self.missing.pop(topic)(message_type, has_header)
            self._subscribe(topic, message_type, received)
        if not self.missing:
            self.complete_s = time.monotonic()
            if self.reported:
                self.writer.line({"note": "its topics are published"})
        elif time.monotonic() - self.started_s > PATIENCE_S:
            self.unpublished([*self.missing])

    def _subscribe(self, topic: str, message_type: Any, received: Callable[[bytes], None]) -> None:
        numbers, reliable = self.numbers.setdefault(topic, Numbers()), all(offered(self.node, topic))
        numbers.last = 0

        def numbered(message: bytes, info: Any) -> None:
            numbers.take(info.get("publication_sequence_number"))
            received(message)

        quality = listening_qos(reliable)
        subscription = self.node.create_subscription(message_type, topic, numbered, quality, raw=True)
        self.subscriptions[topic] = subscription, reliable, received

    def report_missed(self, topics: list[str]) -> None:
        """Write how many messages did not come on each of these topics, where there are more than before.

        Numbers of several publishers say nothing.
        """
        for topic in topics:
            numbers = self.numbers.get(topic, Numbers())
            if self.node.count_publishers(topic) > 1:
                numbers.sent = numbers.heard
            elif (missed := numbers.sent - numbers.heard) > self.missed.get(topic, 0):
                self.missed[topic] = missed
                self.writer.line({"missed": missed, "topic": topic, "sent": numbers.sent})

    def ask(self, now_s: float) -> None:
        """Ask managed nodes for their states, now and then."""
        if now_s - self.asked_s > PATIENCE_S:
            self.asked_s = now_s
            self.managed.ask()

    def unpublished(self, topics: list[str]) -> None:
        """Write that no node publishes these topics, with the nearest of those that one publishes, and why, unless said."""
        names = (name for name, _ in self.node.get_topic_names_and_types())
        known = [name for name in names if self.node.count_publishers(name)]
        near = {one: difflib.get_close_matches(one, known, 1, 0.8) for one in topics}
        named = ", ".join(f"{one} (there is {found[0]})" if found else one for one, found in near.items())
        slip = any(mistyped(one, other) for one, found in near.items() for other in found)
        why = next(self.managed.causes(), None)
        note = f"no node publishes {named}" + (f": {why}" if why else "")
        if note != self.reported:
            self.reported = note
            self.writer.line({"note": note, "misnamed": slip and not why})


class Latencies:
    """Time the requests on two topics."""

    def __init__(self, listener: Listener, options: argparse.Namespace, writer: Writer) -> None:
        self.listener, self.options, self.writer = listener, options, writer
        self.held = Held(options.request, options.timeout) if options.hold else None
        self.matcher = self.held or Matcher(options.match, options.timeout)
        self.warn_at, self.patience_s = 10, PATIENCE_S
        listener.want(options.request, self._requests)
        listener.want(options.response, self._responses)

    def _requests(self, message_type: Any, has_header: bool) -> Callable[[bytes], None]:
        self._check(self.options.request, message_type, has_header)

        def received(message: bytes) -> None:
            now_s = time.monotonic()
            if self._settled(now_s):
                self._write_lost(self.matcher.take_request(self._stamp(message), now_s))

        return received

    def _responses(self, message_type: Any, has_header: bool) -> Callable[[bytes], None]:
        self._check(self.options.response, message_type, has_header)

        def received(message: bytes) -> None:
            now_s = time.monotonic()
            if not self._settled(now_s):
                return
            stamp = self._stamp(message)
            done = self.matcher.take_response(stamp, now_s)
            if done is None:
                if not self.matcher.was_sent_before(stamp):
                    self.writer.unmatched(now_s)
            else:
                self.writer.request(done, failure(self.options.success, message, message_type))

        return received

    def check(self, now_s: float) -> None:
        """Write the requests that are lost by now, warnings and hints."""
        matcher, options = self.matcher, self.options
        self._write_lost(matcher.expire(now_s))
        self.listener.report_missed([options.request, options.response])
        if self.held is not None and (told := self.held.look(now_s, self._is_held())) is not None:
            self.writer.line(told)
        if matcher.answered >= self.warn_at:
            self.warn_at = 2 * matcher.answered
            self.writer.warning(matcher.warning())
        elif not matcher.answered and now_s - self.listener.complete_s > self.patience_s:
            self.patience_s *= 2
            # A topic is known as soon as a node subscribes to it.
            both_ends = [options.request, options.response]
            if silent := [one for one in both_ends if not self.listener.node.count_publishers(one)]:
                self.listener.unpublished(silent)
                return
            heard = f"{matcher.count} requests" if matcher.count else "no request"
            causes = itertools.chain(self.listener.managed.causes(), of_graph(self.listener.node, options.request))
            why = "".join(f": {one}" for one in itertools.islice(causes, 1))
            note = f"{heard} on {options.request}, no response to them on {options.response}{why}"
            self.writer.line({"note": note})

    def _is_held(self) -> bool:
        return os.path.exists(os.path.join(os.path.dirname(self.writer.path or ""), HELD))

    def _settled(self, now_s: float) -> bool:
        return self.options.match == "stamp" or now_s - self.listener.complete_s > SETTLE_S

    def _stamp(self, message: bytes) -> Stamp | None:
        return stamp_of(message) if self.options.match == "stamp" else None

    def _write_lost(self, lost: list[Done]) -> None:
        for one in lost:
            self.writer.request(one)

    def _check(self, topic: str, message_type: Any, has_header: bool) -> None:
        if self.options.match == "stamp" and not has_header:
            kind = f"{message_type.__module__.partition('.')[0]}/{message_type.__name__}"
            sys.exit(f"{topic} carries {kind}, which does not begin with a {HEADER}: match by order instead")


def failure(condition: Condition | None, message: bytes, message_type: Any) -> str | None:
    """Return why a response does not count, or None; exit if its type does not have the field."""
    if condition is None:
        return None
    from rclpy.serialization import deserialize_message

    try:
        return condition.failure(deserialize_message(message, message_type))
    except ValueError as problem:
        sys.exit(str(problem))


def goals(listener: Listener, action: str, writer: Writer) -> None:
    """Time the goals of an action, by UUID."""
    started: dict[bytes, float] = {}
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
                start_s = started.setdefault(goal, now_s)
                if one.status in ENDS:
                    ended[goal] = None
                    del started[goal]
                    if start_s == now_s:
                        continue  # its acceptance was not received
                    done = Done(start_s, now_s - start_s, now_s - max(start_s, departed_s))
                    departed_s = now_s
                    writer.request(done, ENDS[one.status])

        return received

    listener.want(f"{action}/_action/status", received_as)


def metrics(listener: Listener, wanted: list[str], writer: Writer) -> None:
    """Write values of topics' fields."""
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
        # The metric may be a field of the response.
        if topic in listener.missing:
            listener.want(topic, both(listener.missing[topic], received_as(paths)))
        else:
            listener.want(topic, received_as(paths))


def both(one: Callable[..., Any], other: Callable[..., Any]) -> Callable[[Any, bool], Callable[[bytes], None]]:
    """Return a factory of callbacks that call both, `one` first, because it reads the clock."""

    def make(message_type: Any, has_header: bool) -> Callable[[bytes], None]:
        first, second = one(message_type, has_header), other(message_type, has_header)

        def received(message: bytes) -> None:
            first(message)
            second(message)

        return received

    return make


def main(arguments: Sequence[str] | None = None) -> None:
    """Listen until interrupted."""
    words = sys.argv[1:] if arguments is None else arguments
    options = parse(words)
    need_rclpy("topics", words)
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
    checked_s = float("-inf")
    try:
        while rclpy.ok():
            rclpy.spin_once(node, timeout_sec=DISCOVERY_S)
            if time.monotonic() - checked_s >= DISCOVERY_S:
                checked_s = time.monotonic()
                if listener.missing or (timed is not None and not timed.matcher.answered):
                    listener.ask(checked_s)
                listener.subscribe()
                if timed is not None:
                    timed.check(checked_s)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
