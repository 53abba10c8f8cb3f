"""Match by order, from a moment at which nothing is under way, to another one.

A listener that joins a pipeline hears answers to as many requests as were under way, which it did not hear: paired in order,
each latency would be too short by so many periods. Nothing in them distinguishes the two, nor shows what got lost later. So
the supervisor holds back what sends the requests until all is quiet: before the first request that counts, and at the
end, when each of those must have had its response.
"""

from typing import Any

from .matching import Matcher
from .records import Done, Stamp

HELD = "held"  # a file beside the timings: it is there while the senders are held
FEW = 8  # responses, before it is known how far apart they come
LEAST_QUIET_S = 0.5
QUIET = 2.0  # times the longest pause between two responses
# The middleware forgets a process that is stopped for longer than its lease: ten seconds in Cyclone DDS, twenty in Fast DDS.
MOST_HELD_S = 8.0
ON_ITS_WAY_S = 2.0  # a request that was sent before
CANNOT = "match: order cannot tell which request a response answers: match by stamp, or use via: preload"


class Held(Matcher):
    """A matcher by order between two moments at which its senders are held and all is quiet; times of one clock.

    Before the first moment nothing counts. `why` says what refuses the sample.
    """

    def __init__(self, topic: str, timeout_s: float | None = None) -> None:
        super().__init__("order", timeout_s)
        self.topic = topic
        self.phase = "early"  # then "asked", "empty", "released", "counting", "ending", "ended"
        self.why: str | None = None
        self.responses = 0
        self.response_s: float | None = None
        self.pause_s = 0.0  # the longest one between two responses
        self.latest_s = self.held_s = float("-inf")
        self.from_s = float("inf")  # when requests begin to count

    def take_request(self, stamp: Stamp | None, now_s: float) -> list[Done]:
        """Take a request; return those that are lost by now."""
        self.latest_s = now_s
        if self.phase in ("empty", "ending") and now_s - self.held_s > ON_ITS_WAY_S:
            self._refuse(f"requests on {self.topic} come while the workload is held, from others than it")
        return super().take_request(stamp, now_s)

    def take_response(self, stamp: Stamp | None, now_s: float) -> Done | None:
        """Take a response; return its request if it counts."""
        self.latest_s = now_s
        self.responses += 1
        if self.phase not in ("empty", "ending"):
            before_s, self.response_s = self.response_s, now_s
            self.pause_s = max(self.pause_s, 0.0 if before_s is None else now_s - before_s)
        done = super().take_response(stamp, now_s)
        if done is None and self.begun:
            self._refuse("a response came while no request was open")
        return done if done is not None and self._counts(done) else None

    def expire(self, now_s: float) -> list[Done]:
        """Return the requests that are lost by now and count."""
        return list(filter(self._counts, super().expire(now_s)))

    def was_sent_before(self, stamp: Stamp | None) -> bool:
        """Return True: a response without a request refuses the sample, or is from before."""
        return True

    @property
    def begun(self) -> bool:
        """Whether each response is known to be that of a request."""
        return self.phase in ("released", "counting", "ending", "ended")

    def look(self, now_s: float, is_held: bool) -> dict[str, Any] | None:
        """Return what the supervisor is to know; `is_held` says that it holds the senders back."""
        before = self.phase
        if self.phase == "early" and self.responses >= FEW:
            self.phase = "asked"
        elif is_held and self.phase in ("asked", "counting"):
            self.phase = "empty" if self.phase == "asked" else "ending"
            self.held_s = self.latest_s = now_s
        elif self.phase in ("empty", "ending") and now_s - self.latest_s >= self.quiet_s:
            self._quiet(now_s)
        elif self.phase == "released" and not is_held:
            self.phase = "counting"
        if self.phase in ("asked", "empty", "ending"):
            self._check(now_s)
        if self.why is not None:
            return {"hold": False, "refused": self.why}
        told = {"asked": {"hold": True}, "released": {"hold": False}, "ended": {"hold": False, "ended": True}}
        return told.get(self.phase) if self.phase != before else None

    @property
    def quiet_s(self) -> float:
        """For how long nothing comes once nothing is under way."""
        return max(LEAST_QUIET_S, QUIET * self.pause_s)

    def _counts(self, done: Done) -> bool:
        return self.begun and done.start_s >= self.from_s

    def _quiet(self, now_s: float) -> None:
        if self.phase == "ending":
            if self.open:
                self._refuse(f"{len(self.open)} of {self.count} requests had no response")
            self.phase = "ended"
            return
        self.open.clear()
        self.count = self.answered = 0
        self.departed_s = float("-inf")
        self.response_s = None
        # What was held may make up for the requests that it did not send.
        self.from_s = now_s + (now_s - self.held_s)
        self.phase = "released"

    def _check(self, now_s: float) -> None:
        if self.quiet_s > MOST_HELD_S:
            self._refuse(f"responses come up to {self.pause_s:.3g} s apart, too long to wait for the last one")
        elif self.phase != "asked" and now_s - self.held_s > MOST_HELD_S:
            self._refuse(f"responses still came {MOST_HELD_S:g} s after the last request")

    def _refuse(self, what: str) -> None:
        self.why = self.why or f"{what}: {CANNOT}"
