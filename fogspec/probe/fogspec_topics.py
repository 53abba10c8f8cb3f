"""Reads latencies off two topics of unmodified nodes: response minus request (the paper, section 2.B).

    python3 -m fogspec_topics --request /camera/color/image --response /RGBD/pose --match stamp

It runs on the measured machine, inside its ROS 2 environment, beside the nodes: standard library and rclpy. Messages
are not deserialised; with `stamp` both message types must begin with a std_msgs/Header. One line a request is appended
to FOGSPEC_TIMINGS. A request that got no response while `PENDING` later ones arrived is a failed request.
"""

import argparse
import importlib
import json
import os
import struct
import time
from collections import OrderedDict
from typing import Any

PENDING = 1000
DISCOVERY_S = 0.2
HEADER = "std_msgs/Header"


class Pairing:
    """Finds the request of each response; `take_request` and `take_response` return finished (start_s, latency_s).

    A latency of None stands for a request that will get no response. `match`: `stamp` pairs by header stamp; `order`
    the n-th response with the oldest open request; `first_request` with the first request since the last response;
    `last_response` each request with the last response before the next request.
    """

    def __init__(self, match: str) -> None:
        self.match = match
        self.open: OrderedDict[Any, float] = OrderedDict()
        self.count = 0
        self.last: float | None = None

    def take_request(self, stamp: Any, now_s: float) -> list[tuple[float, float | None]]:
        """A request arrived."""
        self.count += 1
        done: list[tuple[float, float | None]] = []
        if self.match == "last_response":
            if self.open and self.last is not None:
                _, start_s = self.open.popitem()
                done.append((start_s, self.last - start_s))
            elif self.open:
                done.append((self.open.popitem()[1], None))
            self.last = None
        elif self.match == "first_request" and self.open:
            return done
        self.open[stamp if self.match == "stamp" else self.count] = now_s
        if len(self.open) > PENDING:
            done.append((self.open.popitem(last=False)[1], None))
        return done

    def take_response(self, stamp: Any, now_s: float) -> list[tuple[float, float | None]]:
        """A response arrived; one that belongs to no request is not counted."""
        if self.match == "last_response":
            self.last = now_s
            return []
        if self.match == "stamp":
            start_s = self.open.pop(stamp, None)
        else:
            start_s = self.open.popitem(last=False)[1] if self.open else None
        return [] if start_s is None else [(start_s, now_s - start_s)]


def stamp_of(message: bytes) -> tuple[int, int]:
    """Seconds and nanoseconds of the std_msgs/Header that a CDR message begins with."""
    order = "<" if message[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", message, 4)
    return seconds, nanoseconds


def write(file: int, name: str, done: list[tuple[float, float | None]]) -> None:
    """Append finished requests, each line by one write."""
    for start_s, latency_s in done:
        ok = latency_s is not None
        record = {"name": name, "start_s": start_s, "latency_s": latency_s if ok else 0.0, "ok": ok, "metrics": {},
                  "reason": None if ok else "no response"}  # fmt: skip
        os.write(file, (json.dumps(record) + "\n").encode())


def main() -> None:
    """Listen until interrupted."""
    parser = argparse.ArgumentParser(prog="fogspec_topics", allow_abbrev=False)
    parser.add_argument("--request", required=True)
    parser.add_argument("--response", required=True)
    parser.add_argument("--match", choices=("stamp", "order", "first_request", "last_response"), default="stamp")
    options = parser.parse_args()
    file = os.open(os.environ.get("FOGSPEC_TIMINGS", os.devnull), os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    listen(options.request, options.response, Pairing(options.match), file)


def listen(request: str, response: str, pairing: Pairing, file: int) -> None:
    """Subscribe to both topics once somebody publishes them."""
    import rclpy
    from rclpy.executors import ExternalShutdownException

    rclpy.init()
    node = rclpy.create_node("fogspec_topics")

    def subscribe(topic: str, take: Any) -> bool:
        kind = dict(node.get_topic_names_and_types()).get(topic)
        if not kind:
            return False
        message_type, has_header = message_of(kind[0])
        if pairing.match == "stamp" and not has_header:
            raise SystemExit(f"{topic} carries {kind[0]}, which does not begin with a {HEADER}: match by order instead")

        def received(message: bytes) -> None:
            now_s = time.monotonic()
            write(file, response, take(stamp_of(message) if pairing.match == "stamp" else None, now_s))

        node.create_subscription(message_type, topic, received, quality(), raw=True)
        return True

    missing = {request: pairing.take_request, response: pairing.take_response}
    try:
        while missing:
            missing = {topic: take for topic, take in missing.items() if not subscribe(topic, take)}
            rclpy.spin_once(node, timeout_sec=DISCOVERY_S)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


def message_of(kind: str) -> tuple[Any, bool]:
    """The message class of `package/msg/Name`, and whether it begins with a header."""
    package, _, name = kind.rpartition("/")
    message_type = getattr(importlib.import_module(package.replace("/", ".")), name)
    first = next(iter(message_type.get_fields_and_field_types().values()), "")
    return message_type, first == HEADER


def quality() -> Any:
    """Best effort hears every publisher, reliable ones too."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)


if __name__ == "__main__":
    main()
