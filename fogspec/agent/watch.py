"""Watch the graph of a robot that runs, for a bounded time, without changing it.

    python3 agent.pyz watch --for 20 --out robot.json          observations, for `fogspec init --from-graph`
    python3 agent.pyz watch --for 30 --bag DIR --topic /rgb    the messages of topics, as a bag of rosbag2 (sqlite3)

It needs the standard library and rclpy. It subscribes to serialised messages with best effort, so that no publisher waits for
it, and takes them from the middleware 50 times per second: times are those at which messages were sent, which the middleware
keeps. If it uses more than a part of one core, it drops its largest topics. It reads the nodes' parameters by their own
services, and their command lines, CPU time and memory from /proc where they run on this computer. Goals of actions are timed by
their status topics, calls of services by their events, where a node publishes them.
"""

import argparse
import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from . import machine_facts
from .graph import Graph, full_name, parameters
from .matching import stamp_of
from .recording import Bag
from .robot_processes import Processes
from .ros import listening_qos, message_of, need_rclpy, offers_reliably, type_of

VERSION = 1
NAME = "fogspec_watch"
POLL_S = 0.02
CPU_LIMIT = 0.5  # of a core
MOST_TOPICS = 300
MOST_OF_TOPIC = 20_000
MOST_MESSAGES = 200_000
MOST_BAG_BYTES = 2**30
SILENT_S = 2.5  # then a reliable subscription replaces one that got nothing
SKEW_NS = 200_000_000  # a message that was sent so long before it came was sent by another clock
ALWAYS = ("/parameter_events", "/rosout", "/clock")
ENDED = {4: "succeeded", 5: "canceled", 6: "aborted"}  # action_msgs/msg/GoalStatus
STATUS, EVENT = "/_action/status", "/_service_event"
SENT, RECEIVED, REPLIED, GOT = range(4)  # service_msgs/msg/ServiceEventInfo

Taken = Callable[[str, bool, bytes, int], None]  # topic, whether it has headers, a serialised message, when sent in ns


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; exit with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="watch", allow_abbrev=False)
    parser.add_argument("--for", dest="seconds", type=float, default=20.0)
    parser.add_argument("--out", help="file for the observations")
    parser.add_argument("--bag", help="folder to make, for the messages of the topics")
    parser.add_argument("--topic", action="append", default=[])
    parser.add_argument("--bytes", type=int, default=MOST_BAG_BYTES, help="most bytes of the bag's messages")
    options = parser.parse_args(arguments)
    if (options.out is None) == (options.bag is None) or (options.bag is not None and not options.topic):
        parser.error("one of --out FILE, and --bag DIR with --topic, is needed")
    return options


class Listener:
    """Subscriptions that are emptied by `poll`, without an executor, whose every turn costs time for each of them."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.subscriptions: dict[str, tuple[Any, bool, Taken]] = {}
        self.cpu_s, self.since_s, self.hot = time.process_time(), time.monotonic(), 0
        self.bytes: dict[str, int] = {}
        self.dropped: list[str] = []
        self.insist: dict[str, float] = {}  # topic -> when it was subscribed to
        self.numbers: dict[str, list[int]] = {}

    def want(self, topic: str, kind: str, taken: Taken, insist: bool = False) -> bool:
        """Subscribe; return whether the type begins with a header. Raise SystemExit if it is not installed.

        `insist` on the messages of a reliable publisher if none comes with best effort: large ones may never be whole.
        """
        message_type, has_header = message_of(kind)
        subscription = self.node.create_subscription(message_type, topic, _never, listening_qos(), raw=True)
        if insist:
            self.insist[topic] = time.monotonic()
        self.subscriptions[topic], self.bytes[topic] = (subscription, has_header, taken), 0
        return has_header

    def run(self, seconds: float, enough: Callable[[], bool]) -> Iterator[None]:
        """Take messages until the time is over; yields once per second."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s and not enough():
            begun_s = time.monotonic()
            self.poll()
            if begun_s - self.since_s >= 1.0:
                self._spare(begun_s)
                self._insist(begun_s)
                yield
            time.sleep(max(0.0, begun_s + POLL_S - time.monotonic()))
        self.poll()

    def poll(self) -> None:
        """Take what has come."""
        for topic, (subscription, has_header, taken) in list(self.subscriptions.items()):
            with subscription.handle:
                while (found := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                    data, info = found
                    self.bytes[topic] += len(data)
                    self._number(topic, info.get("publication_sequence_number"))
                    taken(topic, has_header, data, sent_ns(info))

    def _number(self, topic: str, number: Any) -> None:
        if isinstance(number, int) and 0 < number < 2**63:
            known = self.numbers.setdefault(topic, [number, number])
            known[0], known[1] = min(known[0], number), max(known[1], number)

    def sent(self, topic: str, publishers: int) -> int:
        """Return how many messages a topic's only publisher has sent since the first that came; 0 if it is not known."""
        first, last = self.numbers.get(topic, (1, 0))
        return last - first + 1 if publishers == 1 else 0

    def _insist(self, now_s: float) -> None:
        """Subscribe reliably to topics of reliable publishers from which nothing came for a while."""
        waited = [topic for topic, since_s in self.insist.items() if now_s - since_s > SILENT_S]
        for topic in waited:
            del self.insist[topic]
            if topic not in self.subscriptions or self.bytes[topic]:
                continue
            old, has_header, taken = self.subscriptions[topic]
            new = self.node.create_subscription(old.msg_type, topic, _never, listening_qos(reliable=True), raw=True)
            self.node.destroy_subscription(old)
            self.subscriptions[topic] = new, has_header, taken

    def _spare(self, now_s: float) -> None:
        """Drop the topic with the most bytes if this takes too much of a core for two seconds."""
        cpu_s = time.process_time()
        self.hot = self.hot + 1 if cpu_s - self.cpu_s > CPU_LIMIT * (now_s - self.since_s) else 0
        self.cpu_s, self.since_s = cpu_s, now_s
        if self.hot >= 2 and self.subscriptions:
            self.hot = 0
            topic = max(self.subscriptions, key=lambda name: self.bytes[name])
            self.node.destroy_subscription(self.subscriptions.pop(topic)[0])
            self.dropped.append(topic)


def sent_ns(info: Any) -> int:
    """Return when a message was sent; when it came, if its sender has another clock."""
    now = time.time_ns()
    source, received = info.get("source_timestamp") or 0, info.get("received_timestamp") or now
    return int(source if 0 <= received - source <= SKEW_NS else received)


def _never(_message: Any) -> None:
    """Stand where a subscription wants a callback: no executor ever spins."""


class Observations:
    """All that is heard, within limits on memory."""

    def __init__(self) -> None:
        self.messages: dict[str, list[list[int | None]]] = {}
        self.counts: dict[str, int] = {}
        self.sizes: dict[str, int] = {}
        self.goals: dict[str, dict[bytes, list[Any]]] = {}
        self.calls: dict[str, dict[tuple[bytes, int], dict[int, int]]] = {}
        self.total = 0

    def hear(self, topic: str, has_header: bool, data: bytes, at_ns: int) -> None:
        """Keep time, stamp and size of a message."""
        self.counts[topic] = self.counts.get(topic, 0) + 1
        self.sizes[topic] = self.sizes.get(topic, 0) + len(data)
        kept = self.messages.setdefault(topic, [])
        if len(kept) < MOST_OF_TOPIC and self.total < MOST_MESSAGES:
            self.total += 1
            stamp = None
            if has_header:
                with contextlib.suppress(ValueError):
                    seconds, nanoseconds = stamp_of(data)
                    stamp = seconds * 10**9 + nanoseconds
            kept.append([at_ns, stamp, len(data)])

    def hear_goals(self, topic: str, _has_header: bool, data: bytes, at_ns: int) -> None:
        """Keep when goals of an action were accepted and ended."""
        from action_msgs.msg import GoalStatusArray
        from rclpy.serialization import deserialize_message

        goals = self.goals.setdefault(topic[: -len(STATUS)], {})
        for one in deserialize_message(data, GoalStatusArray).status_list:
            goal = goals.setdefault(bytes(one.goal_info.goal_id.uuid), [at_ns, None, None])
            if one.status in ENDED and goal[1] is None:
                # One that had ended before the watch has no known beginning.
                goal[1:] = [at_ns, ENDED[one.status]]

    def hear_calls(self, topic: str, kind: Any, data: bytes) -> None:
        """Keep the times of a call, as its server and its caller wrote them down."""
        from rclpy.serialization import deserialize_message

        info = deserialize_message(data, kind).info
        calls = self.calls.setdefault(topic[: -len(EVENT)], {})
        key = bytes(info.client_gid), int(info.sequence_number)
        if key in calls or len(calls) < MOST_OF_TOPIC:
            calls.setdefault(key, {})[int(info.event_type)] = info.stamp.sec * 10**9 + info.stamp.nanosec

    def calls_of(self, service: str) -> list[list[int]]:
        """Return begin and end of each whole call in ns: at its server, or else at its caller."""
        found = []
        for times in self.calls.get(service, {}).values():
            for begin, end in ((RECEIVED, REPLIED), (SENT, GOT)):
                if begin in times and end in times:
                    found.append([times[begin], times[end]])
                    break
        return found


class Robot:
    """What was seen of a graph, which may grow while it is watched."""

    def __init__(self, graph: Graph, listener: Listener, heard: Observations) -> None:
        self.graph, self.listener, self.heard = graph, listener, heard
        self.topics: dict[str, dict[str, Any]] = {}
        self.nodes: list[tuple[str, str]] = []
        self.processes = Processes()
        self.headers: dict[str, bool] = {}
        self.failed: dict[str, str] = {}
        self._names: Any = None

    def look(self) -> bool:
        """Add what is new in the graph; return whether something has changed since the last time."""
        names = self.graph.names()
        if names == self._names and self.graph.whole:
            return False
        self._names = names
        for topic, entry in self.graph.topics().items():
            self.topics[topic] = joined(self.topics.get(topic, entry), entry)
        self.nodes += [one for one in names[1] if one not in self.nodes]
        self.graph.find_offers()
        unknown = [name for name in (full_name(*one) for one in self.nodes) if name not in self.processes.found]
        self.processes.add({name: self.graph.gids.get(name, b"") for name in unknown}, self.graph.own_gid)
        return True

    def listen(self) -> None:
        """Subscribe to the topics that are not subscribed to yet."""
        known = {*self.listener.subscriptions, *self.listener.dropped, *self.failed}
        new = {topic: entry for topic, entry in self.topics.items() if topic not in known}
        self.headers |= subscribe(self.listener, self.heard, new, self.failed)


def joined(known: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return a topic as it was seen before and now."""
    names = {key: sorted({*known[key], *new[key]}) for key in ("types", "publishers", "subscribers")}
    reliable = new["reliable"] if new["publishers"] else known["reliable"]
    return {**names, "reliable": reliable, "latched": known["latched"] or new["latched"]}


def watch(seconds: float) -> dict[str, Any]:
    """Return what was seen within the time."""
    import rclpy

    node = rclpy.create_node(NAME, start_parameter_services=False, enable_rosout=False)
    graph, listener, heard = Graph(node), Listener(node), Observations()
    graph.settle()
    robot = Robot(graph, listener, heard)
    robot.look()
    at_first = list(robot.nodes)
    read, lasted_s, own_cpu_s = dict[str, dict[str, Any]](), 0.0, time.process_time()
    if at_first:
        read = parameters(node, at_first)
        robot.listen()
        begun_s, own_cpu_s = time.monotonic(), time.process_time()
        for _ in listener.run(seconds, lambda: False):
            if robot.look():
                robot.listen()
        lasted_s = time.monotonic() - begun_s
    own_cpu_s = time.process_time() - own_cpu_s
    left = {full_name(*one) for one in graph.nodes()}
    if late := [one for one in robot.nodes if one not in at_first]:
        read |= parameters(node, late)
    return {
        "version": VERSION,
        "distro": os.environ.get("ROS_DISTRO"),
        "domain": os.environ.get("ROS_DOMAIN_ID", "0"),
        "seconds": lasted_s,
        "machine": {**machine_facts.read(), "vcpus": os.cpu_count(), "memory_gib": memory_gib()},
        "nodes": {
            full_name(*one): {
                "parameters": read.get(full_name(*one)),
                "process": robot.processes.of(full_name(*one)),
                "gone": full_name(*one) not in left,
                "late": one in late,
            }
            for one in robot.nodes
        },
        "topics": {
            topic: {
                **entry,
                "has_header": robot.headers.get(topic),
                "watched": topic in robot.headers,
                "problem": robot.failed.get(topic),
                "count": heard.counts.get(topic, 0),
                "bytes": heard.sizes.get(topic, 0),
                "sent": listener.sent(topic, len(entry["publishers"])),
                "messages": heard.messages.get(topic, []),
                "dropped": topic in listener.dropped,
            }
            for topic, entry in robot.topics.items()
            if not topic.endswith((STATUS, EVENT))
        },
        "services": {
            name: {**entry, "introspected": f"{name}{EVENT}" in listener.subscriptions, "calls": heard.calls_of(name)}
            for name, entry in graph.services.items()
        },
        "actions": {
            name: {**entry, "goals": [*heard.goals.get(name, {}).values()]} for name, entry in graph.actions.items()
        },
        "overhead": {"cpu": own_cpu_s / lasted_s if lasted_s else 0.0, "bytes": sum(heard.sizes.values())},
    }  # fmt: skip


def memory_gib() -> float:
    """Return this computer's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def subscribe(
    listener: Listener, heard: Observations, topics: dict[str, dict[str, Any]], failed: dict[str, str]
) -> dict[str, bool]:
    """Subscribe to what nodes say to each other, at most `MOST_TOPICS`; return whether each type begins with a header."""
    headers: dict[str, bool] = {}
    # Topics that a node subscribes to, then those that no node does: a result may be for a person alone.
    order = sorted(topics, key=lambda topic: (not topics[topic]["subscribers"], topic))
    for topic in order:
        entry = topics[topic]
        if topic in ALWAYS or not entry["publishers"] or len(listener.subscriptions) >= MOST_TOPICS:
            continue
        if len(entry["types"]) != 1:
            failed[topic] = "it is published with more than one type"
            continue
        kind = entry["types"][0]
        taken: Taken = heard.hear
        timed = topic.endswith((STATUS, EVENT))
        if "/_action/" in topic and not timed:
            continue
        try:
            if timed:
                taken = heard.hear_goals if topic.endswith(STATUS) else _hears_calls(heard, kind)
            has_header = listener.want(topic, kind, taken, entry["reliable"] and not timed)
            if not timed:
                headers[topic] = has_header
        except SystemExit as problem:
            failed[topic] = str(problem)
    return headers


def _hears_calls(heard: Observations, kind: str) -> Taken:
    event = type_of(kind)
    return lambda topic, _has_header, data, _at_ns: heard.hear_calls(topic, event, data)


def record(options: argparse.Namespace) -> None:
    """Write the messages of the topics; exit if one is not published."""
    import rclpy

    node = rclpy.create_node(NAME, start_parameter_services=False, enable_rosout=False)
    graph, listener = Graph(node), Listener(node)
    graph.settle()
    known = dict(node.get_topic_names_and_types())
    for topic in options.topic:
        if len(known.get(topic, [])) != 1:
            sys.exit(f"{topic} is not published, or with more than one type")
    bag = Bag(Path(options.bag), options.bytes)
    for topic in options.topic:
        bag.add(topic, known[topic][0])
        listener.want(topic, known[topic][0], bag.write, insist=offers_reliably(graph.node, topic))
    for _ in listener.run(options.seconds, bag.full):
        bag.base.commit()
    bag.close()
    if not sum(bag.counts.values()):
        sys.exit(f"nothing was published on {', '.join(options.topic)} in {options.seconds:g} s")


def main(arguments: Sequence[str] | None = None) -> None:
    """Watch, and write what was seen."""
    words = sys.argv[1:] if arguments is None else arguments
    options = parse(words)
    need_rclpy("watch", words)
    import rclpy

    rclpy.init()
    if options.bag is not None:
        record(options)
        return
    seen = watch(options.seconds)
    part = Path(f"{options.out}.part")
    part.write_text(json.dumps(seen))
    os.replace(part, options.out)


if __name__ == "__main__":
    main()
