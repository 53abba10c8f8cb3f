"""Send the requests of a recorded bag: the next one after the response (closed-loop), or at a rate (open-loop).

    python3 agent.pyz player --bag data/kitchen --request /camera/color/image --response /RGBD/pose --timeout 10
    python3 agent.pyz player --bag data/calls --service /plan --rate 5 --success 'found == true'

The bag is played forwards and backwards, so that successive requests stay neighbours and the scene never jumps. A request
is sent with all messages recorded since the previous one, on every topic that has a subscriber and no other publisher, with
the quality that was offered. Headers, wherever they are, get new stamps at the same distances, and nodes with `use_sim_time`
the time of these. Hidden topics are left out, and those whose type is not here. Requests of a service are read from its
`_service_event` topic. It needs the standard library and rclpy, and the PyPI package `mcap` for mcap bags.
"""

import argparse
import contextlib
import signal
import sys
import time
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .bag import BagError, Message, messages, offers
from .causes import OWN, Managed
from .matching import stamp_of, with_stamp
from .records import VERDICT, Condition, Stamp, Writer
from .ros import listening_qos, message_of, need_rclpy, offers_reliably, type_of
from .stamps import SECOND, Clock, Headers, headers, shift, shifted

START_S = 120.0
SETTLE_S = 0.5
LEAD_S = 0.01  # between the last of the other messages and the request
ACTIVE_S = 20.0  # for a node to become active that has its publisher and subscription
IGNORED = ("/rosout", "/parameter_events", "/clock")
HIDDEN = "/_"  # in a name, of the topics that actions and services are made of
MEMORY_BYTES = 2**31
REQUEST_SENT, REQUEST_RECEIVED = 0, 1  # service_msgs/msg/ServiceEventInfo


@dataclass
class Turn:
    """One request and the messages recorded since the previous one."""

    request: Message
    before: list[Message] = field(default_factory=list)


def turns(path: Path, request: str, others: bool) -> list[Turn]:
    """Return the bag in turns, each ending with a request; `others` includes the other topics' messages.

    A truncated bag gives its complete turns. Raise BagError if there is none.
    """
    found: list[Turn] = []
    before: list[Message] = []
    size = 0
    try:
        for message in messages(path, None if others else {request}):
            size += len(message.data)
            if size > MEMORY_BYTES:
                break
            if message.topic == request:
                found.append(Turn(message, before))
                before = []
            elif message.topic not in IGNORED:
                before.append(message)
    except BagError as problem:
        if not found:
            raise
        print(f"{problem}: {len(found)} requests are played", flush=True)
    if not found:
        raise BagError(f"{path} has no message of {request}")
    return found


def there_and_back(count: int) -> Iterator[int]:
    """Yield 0, 1, ..., n-1, n-2, ..., 1, 0, 1, ... without end."""
    while True:
        yield from range(count)
        yield from range(count - 2, 0, -1)


def is_latched(message: Message) -> bool:
    """Return whether a message's topic was offered to those that come later."""
    return offers(message.offered)[1] or message.topic.endswith("/tf_static")


class Topics:
    """Send a turn's messages, each with a new stamp."""

    def __init__(self, node: Any, found: list[Turn], options: argparse.Namespace, clock: Clock) -> None:
        self.node, self.turns, self.request, self.clock = node, found, options.request, clock
        first = {one.topic: one for turn in reversed(found) for one in reversed([*turn.before, turn.request])}
        first.pop(options.response, None)
        self.types, self.headers, self.headed = dict[str, Any](), dict[str, Headers](), set[str]()
        self._take_types(first)
        self.responses = 0
        self.last_stamp: Stamp | None = None
        self._subscribe_to(options.response)
        self.publishers = {options.request: self._publisher(first[options.request])}
        self._wait(self._is_heard, "subscribes to", options.request)
        for topic in self.types:
            if topic != options.request and node.count_subscribers(topic) and not node.count_publishers(topic):
                self.publishers[topic] = self._publisher(first[topic])
        # What was published once, nodes may have to have before the first request.
        latched = {topic for topic in self.publishers if is_latched(first[topic])} - {options.request}
        self._send_others(found[0], node.get_clock().now().nanoseconds, latched)
        # A node may take messages of several topics in another order than they came.
        self.lead_s = min(LEAD_S, 0.25 / options.rate) if options.rate else LEAD_S

    def _take_types(self, first: dict[str, Message]) -> None:
        """Load the types of what is played, and print in a line what cannot be."""
        without: list[str] = []
        for topic, message in first.items():
            if HIDDEN in topic and topic != self.request:
                continue
            try:
                message_type, begins = message_of(message.kind)
                self.headers[topic] = headers(message_type)
            except SystemExit:
                if topic == self.request:
                    raise
                without.append(f"{topic} ({message.kind})")
                continue
            self.types[topic] = message_type
            self.headed |= {topic} if begins else set()
        if without:
            print(f"left out, for their types are not here: {', '.join(without)}", flush=True)

    def _is_heard(self) -> bool:
        """Return whether a node other than this package's subscribes to the requests, and all that do have been joined."""
        known = self.node.get_subscriptions_info_by_topic(self.request)
        joined = self.publishers[self.request].get_subscription_count()
        return joined >= len(known) and any(not one.node_name.startswith(OWN) for one in known)

    def _publisher(self, message: Message) -> Any:
        """Return a publisher that offers what was offered when the bag was recorded."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        reliable, latched = offers(message.offered)[0], is_latched(message)
        quality = QoSProfile(depth=100)
        quality.reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        quality.durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        return self.node.create_publisher(self.types[message.topic], message.topic, quality)

    def _subscribe_to(self, topic: str) -> None:
        self._wait(lambda: bool(dict(self.node.get_topic_names_and_types()).get(topic)), "publishes", topic)
        kind = dict(self.node.get_topic_names_and_types())[topic][0]
        message_type, has_header = message_of(kind)

        def received(message: bytes) -> None:
            # A late response to an earlier request that timed out is not this request's.
            if (
                not (has_header and self.last_stamp and self.request in self.headed)
                or stamp_of(message) >= self.last_stamp
            ):
                self.responses += 1

        quality = listening_qos(offers_reliably(self.node, topic))
        self.node.create_subscription(message_type, topic, received, quality, raw=True)

    def _wait(self, there: Callable[[], bool], verb: str, topic: str) -> None:
        import rclpy

        until = time.monotonic() + START_S
        while not there():
            if time.monotonic() > until:
                sys.exit(f"no node {verb} {topic}")
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def send(self, number: int) -> Callable[[], bool]:
        """Send one turn; return a function that tells whether there was a response since."""
        turn, before = self.turns[number], self.responses
        lead_s = self.lead_s if any(one.topic in self.publishers for one in turn.before) else 0.0
        now_ns = self.node.get_clock().now().nanoseconds + round(lead_s * SECOND)
        self.clock.give()
        by_ns = self._send_others(turn, now_ns, self.publishers)
        spin(self.node, lead_s)
        request = self._restamped(turn.request, by_ns)
        if self.request in self.headed:
            self.last_stamp = divmod(now_ns, SECOND)
            request = with_stamp(request, self.last_stamp)
        self.publishers[self.request].publish(request)
        return lambda: self.responses > before

    def _send_others(self, turn: Turn, now_ns: int, topics: Container[str]) -> int:
        """Send what was recorded before the request; return by how much stamps move."""
        # All keep their distance to the request, by their stamps if it has one.
        seconds, rest = stamp_of(turn.request.data) if self.request in self.headed else (0, 0)
        by_ns = now_ns - (seconds * SECOND + rest or round(turn.request.at_s * SECOND))
        for message in turn.before:
            if message.topic in topics:
                self.publishers[message.topic].publish(self._restamped(message, by_ns))
        return by_ns

    def _restamped(self, message: Message, by_ns: int) -> bytes:
        from rclpy.serialization import deserialize_message, serialize_message

        fields = self.headers[message.topic]
        if len(fields) == 1 and message.topic in self.headed:
            at = shifted(stamp_of(message.data), by_ns)
            return message.data if at is None else with_stamp(message.data, at)
        if not fields:
            return message.data
        whole = deserialize_message(message.data, self.types[message.topic])
        shift(whole, fields, by_ns)
        return bytes(serialize_message(whole))


class Service:
    """Call a service with its recorded requests."""

    def __init__(self, node: Any, found: list[Turn], options: argparse.Namespace) -> None:
        import rclpy
        from rclpy.serialization import deserialize_message

        until, kinds = time.monotonic() + START_S, None
        while not (kinds := dict(node.get_service_names_and_types()).get(options.service)):
            if time.monotonic() > until:
                sys.exit(f"no node offers {options.service}")
            rclpy.spin_once(node, timeout_sec=0.1)
        service_type = type_of(kinds[0])
        events = [deserialize_message(turn.request.data, service_type.Event) for turn in found]
        requested = [
            event for event in events if event.info.event_type in (REQUEST_SENT, REQUEST_RECEIVED) and event.request
        ]
        # A call is recorded by its sender, by its receiver, or by both.
        sides = {event.info.event_type for event in requested}
        self.requests = [event.request[0] for event in requested if event.info.event_type == min(sides)]
        if not self.requests:
            sys.exit(
                f"the events of {options.service} hold no requests: record them with service introspection 'contents'"
            )
        self.success = options.success
        self.writer = Writer(options.service)
        self.client = node.create_client(service_type, options.service)
        if not self.client.wait_for_service(START_S):
            sys.exit(f"{options.service} does not answer")

    def send(self, number: int) -> Callable[[], bool]:
        """Call; return a function that tells whether there is a response."""
        response = self.client.call_async(self.requests[number])
        if self.success is not None:
            response.add_done_callback(self._check)
        return lambda: bool(response.done())

    def _check(self, response: Any) -> None:
        now_s = time.monotonic()
        try:
            self.writer.metric({VERDICT: self.success.failure(response.result())}, now_s, None)
        except ValueError as problem:
            sys.exit(str(problem))


def spin(node: Any, for_s: float) -> None:
    """Take what comes for so long."""
    import rclpy

    until_s = time.monotonic() + for_s
    while (left_s := until_s - time.monotonic()) > 0:
        rclpy.spin_once(node, timeout_sec=left_s)


def settle(node: Any) -> None:
    """Let discovery settle, and managed nodes become active, which else lose the first request. Some never do."""
    managed, until_s = Managed(node), time.monotonic() + ACTIVE_S
    while True:
        managed.ask()
        spin(node, SETTLE_S)
        if managed.all_active() or time.monotonic() > until_s:
            return


def play(node: Any, sender: Topics | Service, count: int, rate: float | None, timeout_s: float) -> None:
    """Send requests without end, at `rate` per second or after each response or `timeout_s`."""
    import rclpy

    started_s, gone_on = time.monotonic(), list[int]()
    signal.signal(signal.SIGCONT, lambda got, _frame: gone_on.append(got))
    for sent, number in enumerate(there_and_back(count), start=1):
        if gone_on and rate:  # it was held back, and does not make up for that
            gone_on.clear()
            started_s = time.monotonic() - (sent - 1) / rate
        answered = sender.send(number)
        until = started_s + sent / rate if rate else time.monotonic() + timeout_s
        while (left := until - time.monotonic()) > 0 and (rate or not answered()):
            rclpy.spin_once(node, timeout_sec=left)


def main(arguments: Sequence[str] | None = None) -> None:
    """Play until interrupted."""
    parser = argparse.ArgumentParser(prog="player", allow_abbrev=False)
    parser.add_argument("--bag", required=True)
    parser.add_argument("--request")
    parser.add_argument("--response")
    parser.add_argument("--service")
    parser.add_argument(
        "--success", type=Condition.parse, help="condition on a service's response; topics are checked by the listener"
    )
    parser.add_argument("--rate", type=float)
    parser.add_argument("--timeout", type=float, default=60.0)
    words = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(words)
    need_rclpy("player", words)
    import rclpy
    from rclpy.executors import ExternalShutdownException

    try:
        found = turns(
            Path(options.bag), options.request or f"{options.service}/_service_event", options.service is None
        )
    except BagError as problem:
        sys.exit(str(problem))
    rclpy.init()
    node = rclpy.create_node("fogspec_player")
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        clock = Clock(node)
        sender = Service(node, found, options) if options.service else Topics(node, found, options, clock)
        count = len(sender.requests) if isinstance(sender, Service) else len(found)
        settle(node)
        clock.give()
        play(node, sender, count, options.rate, options.timeout)


if __name__ == "__main__":
    main()
