"""The join of values read from topics with the requests that they belong to."""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass, field

Stamp = tuple[int, int]
# A value that arrives so soon after the end of a request belongs to it, even if the next request is already running.
JUST_ENDED_S = 0.05
VERDICT = "!"


@dataclass(slots=True, kw_only=True)
class Request:
    """One request, in seconds of one clock; `service_s` is the time that the node worked on it, without waiting.

    `number` counts the starts of its name in its `process`; `above` is that of another one that was open in the same place,
    where the probe could only guess which of them ended.
    """

    name: str
    latency_s: float
    ok: bool
    metrics: dict[str, object]
    reason: str | None = None
    scenario: str = ""
    start_s: float | None = None
    service_s: float | None = None
    lost: bool = False
    stamp: Stamp | None = None
    process: str = ""
    number: int | None = None
    above: int | None = None


@dataclass(frozen=True, slots=True)
class Value:
    """The values of a message, by metric."""

    values: dict[str, object]
    at_s: float
    stamp: Stamp | None = None


@dataclass(slots=True)
class _Ends:
    times_s: list[float] = field(default_factory=list)
    requests: list[Request] = field(default_factory=list)


def join(requests: Sequence[Request], values: Sequence[Value]) -> None:
    """Add each value to the metrics of its request; a value that belongs to no request is dropped.

    By stamp if both have one. Otherwise by time: the request that has just ended; else the running one, of several the one
    that ends first; else the last one that has ended. No request gets a second value of a metric. A value under `VERDICT`
    is not a metric but the reason why a request has failed.
    """
    by_stamp = {one.stamp: one for one in requests if one.stamp is not None}
    timed = sorted(
        (one for one in requests if one.start_s is not None and not one.lost),
        key=lambda one: (one.start_s or 0.0) + one.latency_s,
    )
    ends = _Ends([(one.start_s or 0.0) + one.latency_s for one in timed], timed)
    for value in sorted(values, key=lambda one: one.at_s):
        found = by_stamp.get(value.stamp) if value.stamp is not None else None
        found = found or _at(ends, value)
        if found is not None:
            found.metrics = {**value.values, **found.metrics}
    for one in requests:
        if one.ok and isinstance(why := one.metrics.pop(VERDICT, None), str):
            one.ok, one.reason = False, why


def _at(ends: _Ends, value: Value) -> Request | None:
    i = bisect.bisect_right(ends.times_s, value.at_s)
    before = ends.requests[i - 1] if i else None
    lacks = before is not None and not value.values.keys() <= before.metrics.keys()
    if before is not None and lacks and value.at_s - ends.times_s[i - 1] <= JUST_ENDED_S:
        return before
    if i < len(ends.requests) and (ends.requests[i].start_s or 0.0) <= value.at_s:
        return ends.requests[i]
    return before if lacks else None
