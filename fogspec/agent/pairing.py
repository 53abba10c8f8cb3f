"""Finds the request of each response on two topics. Standard library only.

`stamp` pairs by header stamp, `order` the n-th response with the oldest open request. The other two are the heuristics of
the paper's own code, for comparison: `first_request` counts from the first request since the last response, `last_response`
from the last response. Each is right in one regime only, and says so in `warning` when the load is outside it.
"""

import struct
from collections import OrderedDict
from typing import Any

from .records import Done, Stamp

PENDING = 1000
OUTSIDE = 0.05
HEADER_BYTES = 12
HEADER = "std_msgs/Header"


class Pairing:
    """Takes requests and responses in the order of their times, gives the requests that are over.

    A request that has no response after `timeout_s`, or after `PENDING` later ones, is lost; save for those before the first
    one that was answered, which came while the node was not ready or not everybody knew of everybody yet.
    """

    def __init__(self, match: str, timeout_s: float | None = None) -> None:
        self.match, self.timeout_s = match, timeout_s
        self.open: OrderedDict[Any, float] = OrderedDict()
        self.count = self.answered = self.outside = 0
        self.departed_s = float("-inf")

    def take_request(self, stamp: Stamp | None, now_s: float) -> list[Done]:
        """A request arrived; returns those that are lost by now."""
        self.count += 1
        lost = self.expire(now_s)
        # Each response is thought to answer one request: then nothing was left to do at the last one.
        self.outside += self.match == "last_response" and self.answered == self.count - 1 and self.answered > 0
        if self.match in ("first_request", "last_response") and self.open:
            self.outside += self.match == "first_request"
            return lost
        self.open[stamp if self.match == "stamp" else self.count] = now_s
        if len(self.open) > PENDING:
            lost += self._lost()
        return lost

    def take_response(self, stamp: Stamp | None, now_s: float) -> Done | None:
        """A response arrived; None when it belongs to no request."""
        if self.match == "last_response":
            return self._since_last(now_s)
        if self.match == "stamp":
            while stamp in self.open and not self.answered and next(iter(self.open)) != stamp:
                self.open.popitem(last=False)
            start_s = self.open.pop(stamp, None)
        else:
            start_s = self.open.popitem(last=False)[1] if self.open else None
        return None if start_s is None else self._done(start_s, now_s, stamp)

    def expire(self, now_s: float) -> list[Done]:
        """The requests that are lost by now."""
        lost: list[Done] = []
        while self.timeout_s is not None and self.open and now_s - next(iter(self.open.values())) > self.timeout_s:
            lost += self._lost()
        return lost

    def warning(self) -> str | None:
        """Why the figures mislead, when the load is not what the way of matching takes for granted."""
        if self.answered < 1 or self.outside <= OUTSIDE * max(self.count, 1):
            return None
        share = f"{self.outside / max(self.count, 1):.0%}"
        if self.match == "first_request":
            return (
                f"first_request: {share} of the requests came while another was open, and their waiting is not counted"
            )
        return f"last_response: {share} of the requests found the node idle, and the idle time is counted as latency"

    def _since_last(self, now_s: float) -> Done | None:
        # Counts from the last response, or from the first request of all; the regime is a node that is never idle.
        start_s = self.departed_s if self.answered else next(iter(self.open.values()), None)
        if start_s is None:
            return None
        self.open.clear()
        return self._done(start_s, now_s, None)

    def _done(self, start_s: float, now_s: float, stamp: Stamp | None) -> Done:
        service_s = now_s - max(start_s, self.departed_s)
        self.departed_s = now_s
        self.answered += 1
        return Done(start_s, now_s - start_s, service_s, stamp)

    def _lost(self) -> list[Done]:
        key, start_s = self.open.popitem(last=False)
        return [Done(start_s, None, None, key if self.match == "stamp" else None)] if self.answered else []


def stamp_of(message: bytes) -> Stamp:
    """Seconds and nanoseconds of the std_msgs/Header that a CDR message begins with; raises ValueError when it is too short."""
    if len(message) < HEADER_BYTES:
        raise ValueError("the message is too short to begin with a header")
    seconds, nanoseconds = struct.unpack_from(f"{_order(message)}iI", message, 4)
    return seconds, nanoseconds


def stamped(message: bytes, stamp: Stamp) -> bytes:
    """The message with another stamp in the header that it begins with."""
    return message[:4] + struct.pack(f"{_order(message)}iI", *stamp) + message[HEADER_BYTES:]


def _order(message: bytes) -> str:
    return "<" if message[1] & 1 else ">"
