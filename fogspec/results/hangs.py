"""Hang detection: judge a timed-out sample by the gap since its last finished request."""

import itertools
from collections.abc import Sequence

from fogspec.base.units import shown_duration
from fogspec.results.join import Request

PAUSES = 3.0
LEAST_S = 1.0  # a busy machine and the polling of the agent cause pauses too


def detect_hang(
    requests: Sequence[Request], waited_s: float | None, timeout_s: float | None, valid: float
) -> tuple[str | None, bool]:
    """Return a description of the hang, None if there is none, and whether it is tolerable.

    `waited_s` is the time since the last request finished while all processes still ran. The node hangs if that exceeds the
    longest pause between two finished requests plus `timeout_s`, or without one `PAUSES` such pauses. A hang is
    tolerable up to the fraction of the time that requests may fail: 1 - `valid`.
    """
    times = [(one.start_s, one.start_s + one.latency_s) for one in requests if one.start_s is not None]
    if waited_s is None or len(times) < len(requests) or not times:
        return None, True
    starts, ends = sorted(start_s for start_s, _ in times), sorted(end_s for _, end_s in times)
    pauses = [later - earlier for earlier, later in itertools.pairwise(ends)]
    longest_s = max([*pauses, *(one.latency_s for one in requests)])
    most_s = longest_s + timeout_s if timeout_s is not None else PAUSES * longest_s
    if waited_s <= max(most_s, LEAST_S):
        return None, True
    last = shown_duration(round(waited_s, 1))
    said = f"no request was finished in the last {last}, though all processes ran: the node hangs"
    return said, waited_s <= (1 - valid) * (waited_s + ends[-1] - starts[0])
