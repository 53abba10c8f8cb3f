"""What the nodes do in use against what the model predicted: the paper's runtime monitor (section 2.A, step 5).

Drift is a statement about the model, in both directions: the observed statistic's 95 % interval lies wholly outside the
predicted interval. Latencies are taken on the machine, as they were when it was measured, so the network has no part.
"""

import io
import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fogspec.base import units
from fogspec.catalog.cost import Costs
from fogspec.catalog.machine import Machine
from fogspec.compile.manifest import Expected
from fogspec.results.requests import RecordRules, parse_requests
from fogspec.results.schema import LatencySummary
from fogspec.results.statistics import NEEDED, QUANTILES, summary, weights
from fogspec.spec.schema import Application

Drift = Literal["none", "slower", "faster", "unknown"]
# Few enough that a change shows soon, enough for the interval of a 99th percentile.
LEAST, LATEST = 30, 1000
Z95 = statistics.NormalDist().inv_cdf(0.975)


@dataclass(frozen=True, slots=True)
class Observed:
    """The latest requests: how many, their statistics, and what follows for the model and the limits.

    `interval_s` is the 95 % interval of the statistic that the spec bounds; `breaks` names limits that are not met.
    """

    requests: int
    failed: int
    latency: LatencySummary | None
    value_s: float | None
    interval_s: tuple[float, float] | None
    cost_usd_per_request: float | None
    drift: Drift
    breaks: tuple[str, ...]


def observe(timings: bytes, application: Application, expected: Expected, machine: Machine) -> Observed:
    """Compare the latest requests with what was expected of this machine."""
    rules = replace(RecordRules.of(application), warmup=0)
    requests = parse_requests(io.BytesIO(b"".join(timings.splitlines(keepends=True)[-LATEST:])), rules)
    known = requests.latencies_s
    found = summary(known, weights(requests.scenarios, rules.scenarios))
    statistic = expected.latency.statistic
    value = None if found is None else getattr(found, statistic)
    spread = interval_s(known, statistic)
    cost = None if value is None else _cost(application, machine, value)
    breaks = tuple(_breaks(expected, spread, cost, len(known), requests.failed, rules.valid))
    return Observed(
        len(known), requests.failed, found, value, spread, cost, drift(spread, expected.latency.interval), breaks
    )


def drift(observed_s: tuple[float, float] | None, predicted_s: tuple[float, float] | None) -> Drift:
    """Whether the model still holds; unknown without an interval on either side."""
    if observed_s is None or predicted_s is None:
        return "unknown"
    if observed_s[0] > predicted_s[1]:
        return "slower"
    return "faster" if observed_s[1] < predicted_s[0] else "none"


def interval_s(latencies_s: Sequence[float], statistic: str) -> tuple[float, float] | None:
    """The 95 % interval of a statistic of requests in the order they came; None for too few of them.

    Mean: widened by the lag-1 autocorrelation, for successive requests resemble each other. Quantiles: binomial order
    statistics.
    """
    n = len(latencies_s)
    if n < max(LEAST, NEEDED.get(statistic, 1)):
        return None
    if statistic == "mean":
        mean = statistics.fmean(latencies_s)
        deviations = [x - mean for x in latencies_s]
        square = math.fsum(d * d for d in deviations)
        lag = math.fsum(a * b for a, b in itertools.pairwise(deviations)) / square if square else 0.0
        lag = min(max(lag, 0.0), 0.99)
        half = Z95 * math.sqrt(square / (n - 1) / n * (1 + lag) / (1 - lag))
        return mean - half, mean + half
    share, ordered = QUANTILES[statistic], sorted(latencies_s)
    spread = Z95 * math.sqrt(n * share * (1 - share))
    low, high = math.floor(n * share - spread), math.ceil(n * share + spread)
    return None if low < 0 or high >= n else (ordered[low], ordered[high])


def _cost(application: Application, machine: Machine, latency_s: float) -> float:
    """USD per request, as the choice reckons it: with data transfer, and the interruptions of a spot machine."""
    costs = Costs.of(application.spec, np.array([machine.price]), np.array([machine.spot]))
    return float(costs.per_request(np.array([latency_s]))[0])


def _breaks(
    expected: Expected, spread: tuple[float, float] | None, cost: float | None, n: int, failed: int, valid: float
) -> list[str]:
    found, latency = [], expected.latency
    limit = None if latency.limit is None else latency.limit - latency.network_allowance
    if limit is not None and spread is not None and spread[0] > limit:
        found.append(f"{latency.statistic} latency is over its limit of {units.format_duration(limit)}")
    if expected.cost.limit is not None and cost is not None and spread is not None and cost > expected.cost.limit:
        found.append(
            f"a request costs {units.format_cost(cost)}, over its limit of {units.format_cost(expected.cost.limit)}"
        )
    if n + failed >= LEAST and n < valid * (n + failed):
        found.append(f"{failed} of {n + failed} requests failed")
    return found
