"""Drift detection: the observed latency against the predicted one, as the paper's runtime monitor (section 2.A, step 5).

Drift is a statement about the model, in both directions: the observed statistic's 95% interval lies wholly outside the
predicted interval. Latencies are taken on the machine, as they were when it was measured, so the network has no part.
"""

import io
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Literal

import numpy as np

from fogspec.agent.intervals import interval
from fogspec.base import units
from fogspec.catalog.cost import Costs
from fogspec.catalog.machine import Machine
from fogspec.compile.manifest import Expected
from fogspec.language.schema import Application
from fogspec.results.arrivals import at_rate
from fogspec.results.requests import RecordRules, Requests, parse_requests
from fogspec.results.schema import LatencySummary
from fogspec.results.statistics import NEEDED, latency_of

Drift = Literal["none", "slower", "faster", "unknown"]
# Few enough that a change shows soon, enough for the interval of a 99th percentile.
LEAST, LATEST = 30, 1000


class Limit(StrEnum):
    """The limits that a deployment can violate."""

    LATENCY = "latency"
    COST = "cost"
    SUCCESS_RATE = "success rate"


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """The latest requests: their number and statistics, and the consequences for the model and the limits.

    `interval_s` is the 95% interval of the statistic that the spec bounds, as `cost_interval` is of the cost in USD a request;
    `violated` are limits that are not met, `unclear` those that lie inside of an interval. One request has been open for
    `waited_s`, and none has ended since its start. The first requests of each process, its warm-up, do not count.
    """

    requests: int
    failed: int
    latency: LatencySummary | None
    value_s: float | None
    interval_s: tuple[float, float] | None
    cost_usd_per_request: float | None
    drift: Drift
    violated: tuple[Limit, ...]
    unclear: tuple[Limit, ...] = ()
    cost_interval: tuple[float, float] | None = None
    waited_s: float | None = None


def observe(
    timings: bytes, application: Application, expected: Expected, machine: Machine, clock_s: float | None = None
) -> Observed:
    """Compare the latest requests with the expectations for this machine, where it is `clock_s` by the clock of the timings.

    At the declared rate, if there is one: requests that followed one another did not wait.
    """
    rules = RecordRules.of(application)
    requests, load = parse_requests(io.BytesIO(_latest(timings)), rules, clock_s), application.spec.objective.load
    if load is not None:  # as the expectations are
        requests = at_rate(requests, load.rate)
    known, found = requests.latencies_s, latency_of(requests, rules.scenarios)
    statistic = expected.latency.statistic
    value = None if found is None else getattr(found, statistic)
    spread = _spread_s(requests, statistic, rules.scenarios)
    cost, costs = None, None
    if found is not None:
        busy_s, of_mean = requests.busy_s(found.mean), _spread_s(requests, "mean", rules.scenarios)
        cost = _cost(application, machine, busy_s)
        if of_mean is not None and found.mean:
            low, high = (_cost(application, machine, busy_s * max(end_s / found.mean, 0.0)) for end_s in of_mean)
            costs = low, high
    bounds = {
        Limit.LATENCY: (spread, expected.latency.limit_on_machine),
        Limit.COST: (costs, expected.cost.limit),
    }
    judged = {limit: (ends, most) for limit, (ends, most) in bounds.items() if ends is not None and most is not None}
    violated = [limit for limit, (ends, most) in judged.items() if ends[0] > most]
    n = len(known) + requests.failed
    if n >= LEAST and len(known) < rules.valid * n:
        violated.append(Limit.SUCCESS_RATE)
    return Observed(
        requests=len(known),
        failed=requests.failed,
        latency=found,
        value_s=value,
        interval_s=spread,
        cost_usd_per_request=cost,
        drift=drift(spread, expected.latency.interval),
        violated=tuple(violated),
        unclear=tuple(limit for limit, (ends, most) in judged.items() if ends[0] <= most < ends[1]),
        cost_interval=costs,
        waited_s=requests.balance.waited_s,
    )


def _latest(timings: bytes) -> bytes:
    """Return the lines from the `LATEST` last ones on that are not starts of requests."""
    lines = timings.splitlines(keepends=True)
    ends = [number for number, line in enumerate(lines) if not line.startswith(b'{"open":')]
    return b"".join(lines[ends[-LATEST] if len(ends) > LATEST else 0 :])


def drift(observed_s: tuple[float, float] | None, predicted_s: tuple[float, float] | None) -> Drift:
    """Return whether and in which direction the intervals are disjoint; unknown without one of them."""
    if observed_s is None or predicted_s is None:
        return "unknown"
    if observed_s[0] > predicted_s[1]:
        return "slower"
    return "faster" if observed_s[1] < predicted_s[0] else "none"


def _spread_s(requests: Requests, statistic: str, scenarios: Mapping[str, float]) -> tuple[float, float] | None:
    if statistic == "mean":
        return interval_s(requests.latencies_s, statistic, requests.scenarios, scenarios)
    return interval_s(
        [wait_s for wait_s, _ in requests.waits_s], statistic, [kind for _, kind in requests.waits_s], scenarios
    )


def interval_s(
    latencies_s: Sequence[float],
    statistic: str,
    kinds: Sequence[str] = (),
    scenarios: Mapping[str, float] | None = None,
) -> tuple[float, float] | None:
    """Return the 95% interval of a statistic of requests in the order they came; None for too few of them.

    With `scenarios` by weight, requests are of these `kinds`.
    """
    if len(latencies_s) < max(LEAST, NEEDED.get(statistic, 1)):
        return None
    found = interval(latencies_s, statistic, kinds=kinds, weights=scenarios)
    return (found.low, found.high) if math.isfinite(found.half) else None


@cache
def needed(statistic: str) -> int:
    """Return the least number of requests for which `interval_s` knows the interval, if they do not resemble each other."""
    return next(n for n in itertools.count(LEAST) if interval_s([1.0] * n, statistic) is not None)


def _cost(application: Application, machine: Machine, busy_s: float) -> float:
    """Return USD per request with disk, address and data transfer, and the interruptions of a spot machine."""
    costs = Costs.of(application.spec, np.array([machine.paid_usd_per_hour]), np.array([machine.spot]))
    return float(costs.per_request(np.array([busy_s]))[0])


def violation_text(limit: Limit, observed: Observed, expected: Expected) -> str:
    """Return the description of a limit that is not met."""
    if limit is Limit.LATENCY:
        most_s = units.shown_duration(expected.latency.limit_on_machine or 0.0)
        return f"{expected.latency.statistic} latency is over its limit of {most_s}"
    if limit is Limit.COST:
        cost, most = observed.cost_usd_per_request or 0.0, expected.cost.limit or 0.0
        return f"a cost of {units.shown_cost(cost)} is over its limit of {units.shown_cost(most)}"
    return f"{observed.failed} of {observed.requests + observed.failed} requests failed"


def unclear_text(limit: Limit, observed: Observed, expected: Expected) -> str:
    """Return the interval that is too wide to say whether a limit is met."""
    if limit is Limit.LATENCY and observed.value_s is not None:
        seen = f"{units.shown_duration(observed.value_s)}{units.shown_interval(observed.interval_s)}"
        most = units.shown_duration(expected.latency.limit_on_machine or 0.0)
        return f"{expected.latency.statistic} latency {seen} against its limit of {most}"
    low, high, most = map(units.shown_cost, (*(observed.cost_interval or (0.0, 0.0)), expected.cost.limit or 0.0))
    return f"a cost of {low} to {high} against its limit of {most}"
