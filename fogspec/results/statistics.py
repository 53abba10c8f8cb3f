"""Statistics of the requests of one sample, weighted by scenario if the spec gives their frequencies."""

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence

from fogspec.agent.intervals import QUANTILES
from fogspec.results.requests import RecordRules, Requests
from fogspec.results.resources import between_s
from fogspec.results.schema import LatencySummary, ResourceUse

# A quantile is reported if on average one request lies beyond it, a mean from the first request on.
NEEDED = {"mean": 1, "p50": 2, "p95": 20, "p99": 100}


def weights(kinds: Sequence[str], scenarios: Mapping[str, float]) -> list[float]:
    """Return the weight of each request; they sum to 1, and each scenario has the weight that `scenarios` gives it."""
    if not scenarios:
        return [1 / max(len(kinds), 1)] * len(kinds)
    count = Counter(kinds)
    total = math.fsum(scenarios[kind] for kind in count)
    return [scenarios[kind] / total / count[kind] for kind in kinds]


def summary(latencies_s: Sequence[float], shares: Sequence[float]) -> LatencySummary | None:
    """Return mean, standard deviation and quantiles of latencies with these weights; None for no request.

    With equal weights the deviation is that of a sample (n - 1), and quantiles are linear between order statistics.
    """
    n = len(latencies_s)
    if not n:
        return None
    pairs = sorted(zip(latencies_s, shares, strict=True))
    mean = math.fsum(x * share for x, share in pairs)
    freedom = 1 - math.fsum(share**2 for share in shares)
    sd = math.sqrt(math.fsum(share * (x - mean) ** 2 for x, share in pairs) / freedom) if n > 1 else None
    known = {name: quantile(pairs, q) for name, q in QUANTILES.items() if n >= NEEDED[name]}
    # Field types read text with units; these are numbers already.
    return LatencySummary.model_construct(
        mean=mean, sd=sd, p50=known.get("p50"), p95=known.get("p95"), p99=known.get("p99")
    )


def latency_of(requests: Requests, scenarios: Mapping[str, float]) -> LatencySummary | None:
    """Return the statistics of the valid requests; late ones, which have failed, count in percentiles with their wait."""
    found = summary(requests.latencies_s, weights(requests.scenarios, scenarios))
    if found is None or len(requests.waits_s) == len(requests.latencies_s):
        return found
    waits_s, kinds = zip(*requests.waits_s, strict=True)
    late = summary(waits_s, weights(kinds, scenarios))
    return found.model_copy(update={name: getattr(late, name) for name in QUANTILES})


def paid_s(requests: Requests, mean_s: float, use: ResourceUse | None, rules: RecordRules) -> float:
    """Return the time that is paid for each valid request: while one is open, and of the node's own work between them."""
    open_s, n = requests.busy_s(mean_s), len(requests.latencies_s)
    if use is None or rules.workload:
        return open_s
    return max(open_s, min(open_s + between_s(use, requests.open_s, n), use.window / n))


def quantile(pairs: Sequence[tuple[float, float]], share: float) -> float:
    """Return the value below which `share` of the weight lies, of ordered (value, weight): linear between the values."""
    span = math.fsum(own for _, own in pairs[:-1])
    if span <= 0:
        return pairs[0][0]
    before, target = 0.0, share * span
    for (value, own), (above, _) in itertools.pairwise(pairs):
        if before + own >= target:
            return value + (above - value) * (target - before) / own
        before += own
    return pairs[-1][0]
