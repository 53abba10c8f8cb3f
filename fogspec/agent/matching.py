"""Match each response on a topic with its request on another.

`stamp` matches by header stamp, `order` the n-th response with the oldest open request. The other two are the heuristics of
the paper's own code, for comparison: `first_request` counts from the first request since the last response, `last_response`
from the last response. Each is right in one regime only; `Matcher.warning` reports a load outside of it.
"""

import struct
from collections import OrderedDict
from typing import Any

from .records import Done, Stamp

PENDING = 1000
OUTSIDE = 0.05
NOT_UNIQUE = "its stamp {}.{:09d} is that of an earlier request: give each its own, or match by order"
HEADER_BYTES = 12
HEADER = "std_msgs/Header"


class Matcher:
    """Take requests and responses in the order of their times, and return the requests that are finished.

    A request without a response after `timeout_s` seconds, or after `PENDING` later requests, is lost. Requests before the
    first answered one do not count: the node was not ready, or discovery was not complete. Nor do responses to requests that
    were sent before the first that was heard. Of requests with one stamp, all but the first have failed: what a
    response answers is not known.
    """

    def __init__(self, match: str, timeout_s: float | None = None) -> None:
        self.match, self.timeout_s = match, timeout_s
        self.open: OrderedDict[Any, float] = OrderedDict()
        self.count = self.answered = self.outside = 0
        self.departed_s = float("-inf")
        self.first: Stamp | None = None
        self.stamps: OrderedDict[Stamp | None, None] = OrderedDict()

    def take_request(self, stamp: Stamp | None, now_s: float) -> list[Done]:
        """Take a request; return those that are lost by now."""
        self.count += 1
        self.first = self.first or stamp
        lost = self.expire(now_s)
        # If each response answers one request, the node was idle since the last one.
        self.outside += self.match == "last_response" and self.answered == self.count - 1 and self.answered > 0
        if self.match in ("first_request", "last_response") and self.open:
            self.outside += self.match == "first_request"
            return lost
        if self.match == "stamp" and self._was_heard(stamp) and self.answered:
            return [*lost, Done(now_s, None, why=NOT_UNIQUE.format(*stamp or (0, 0)))]
        self.open[stamp if self.match == "stamp" else self.count] = now_s
        if len(self.open) > PENDING:
            lost += self._lost()
        return lost

    def take_response(self, stamp: Stamp | None, now_s: float) -> Done | None:
        """Take a response; return its request, or None if there is none."""
        if self.match == "last_response":
            return self._since_last(now_s)
        if self.match == "stamp":
            while stamp in self.open and not self.answered and next(iter(self.open)) != stamp:
                self.open.popitem(last=False)
            start_s = self.open.pop(stamp, None)
        else:
            start_s = self.open.popitem(last=False)[1] if self.open else None
        return None if start_s is None else self._done(start_s, now_s, stamp)

    def was_sent_before(self, stamp: Stamp | None) -> bool:
        """Return whether a response without a request answers one from before the first that was heard."""
        return self.count == 0 or (stamp is not None and self.first is not None and stamp < self.first)

    def expire(self, now_s: float) -> list[Done]:
        """Return the requests that are lost by now."""
        lost: list[Done] = []
        while self.timeout_s is not None and self.open and now_s - next(iter(self.open.values())) > self.timeout_s:
            lost += self._lost()
        return lost

    def warning(self) -> str | None:
        """Return why the latencies are misleading if the load is not what the method assumes, else None."""
        if self.answered < 1 or self.outside <= OUTSIDE * max(self.count, 1):
            return None
        share = f"{self.outside / max(self.count, 1):.0%}"
        if self.match == "first_request":
            return (
                f"first_request: {share} of the requests came while another was open, and their waiting is not counted"
            )
        return f"last_response: {share} of the requests found the node idle, and the idle time is counted as latency"

    def _was_heard(self, stamp: Stamp | None) -> bool:
        """Return whether one of the latest requests had this stamp, and remember it."""
        known = stamp in self.stamps
        self.stamps[stamp] = None
        if len(self.stamps) > PENDING:
            self.stamps.popitem(last=False)
        return known

    def _since_last(self, now_s: float) -> Done | None:
        # Right for a node that is never idle. The first response counts from the first request.
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
    """Return seconds and nanoseconds of the std_msgs/Header that a CDR message begins with.

    Raise ValueError if the message is too short.
    """
    if len(message) < HEADER_BYTES:
        raise ValueError("the message is too short to begin with a header")
    seconds, nanoseconds = struct.unpack_from(f"{_order(message)}iI", message, 4)
    return seconds, nanoseconds


def with_stamp(message: bytes, stamp: Stamp) -> bytes:
    """Return the message with another stamp in the header that it begins with."""
    return message[:4] + struct.pack(f"{_order(message)}iI", *stamp) + message[HEADER_BYTES:]


def _order(message: bytes) -> str:
    return "<" if message[1] & 1 else ">"
