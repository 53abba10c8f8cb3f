"""Statistics of the requests of one sample, weighted by scenario if the spec gives their frequencies."""

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from fogspec.agent.intervals import QUANTILES, SHARE, error_of, quantile
from fogspec.results.ranges import ERROR
from fogspec.results.requests import RecordRules, Requests
from fogspec.results.resources import between_s
from fogspec.results.schema import LatencySummary, ResourceUse

# A quantile is reported if on average one request lies beyond it, a mean from the first request on.
NEEDED = {"mean": 1, "p50": 2, "p95": 20, "p99": 100}
UNSTEADY = 20  # requests from which it is said that some are unlike the others
ALONE, TOGETHER = 0.3, 4.0  # of all time, in one request; times that of as many others
BATCHES, BATCH = 30, 5
GROWTH, CERTAIN = 0.1, 2.5  # between the halves; standard deviations of Kendall's sum without a trend


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


def errors_of(requests: Requests, scenarios: Mapping[str, float]) -> dict[str, float]:
    """Return the relative standard error of each statistic of the latency of which something can be said, by its name."""
    waits_s, kinds = zip(*requests.waits_s, strict=True) if requests.waits_s else ((), ())
    found = {name: error_of(waits_s, name, kinds, scenarios) for name, n in NEEDED.items() if len(waits_s) >= n}
    if found:
        found["mean"] = error_of(requests.latencies_s, "mean", requests.scenarios, scenarios)
    return {name: error for name, error in found.items() if error <= ERROR.most}


def unsteady(latencies_s: Sequence[float]) -> Iterator[str]:
    """Yield sentences on what a mean hides of latencies in the order they came: growth, and times that a few requests made."""
    n, whole_s = len(latencies_s), math.fsum(latencies_s)
    if n < UNSTEADY or not whole_s:
        return
    count = min(BATCHES, n // BATCH)
    edges = [n * number // count for number in range(count + 1)]
    means = [math.fsum(latencies_s[i:j]) / (j - i) for i, j in itertools.pairwise(edges)]
    later = sum((b > a) - (b < a) for a, b in itertools.combinations(means, 2))
    first, second = (math.fsum(part) / len(part) for part in (latencies_s[: n // 2], latencies_s[n // 2 :]))
    if abs(later) > CERTAIN * math.sqrt(count * (count - 1) * (2 * count + 5) / 18) and first and second:
        change = max(first, second) / min(first, second) - 1
        if change > GROWTH:
            yield f"the {'second' if second > first else 'first'} half was {change:.0%} slower than the other"
    longest_s, slowest = max(latencies_s), max(range(count), key=means.__getitem__)
    if longest_s > ALONE * whole_s:
        yield f"one of {n} requests took {longest_s / whole_s:.0%} of their time"
    elif means[slowest] > TOGETHER * whole_s / n:
        part_s = math.fsum(latencies_s[edges[slowest] : edges[slowest + 1]])
        yield f"requests {edges[slowest] + 1} to {edges[slowest + 1]} of {n} took {part_s / whole_s:.0%} of their time"


def metric_of(values: Sequence[tuple[float, str]], scenarios: Mapping[str, float]) -> tuple[float, float]:
    """Return the mean of one or more (value, scenario), and its relative standard error: infinite where it is not known."""
    numbers, kinds = zip(*values, strict=True)
    mean = math.fsum(one * share for one, share in zip(numbers, weights(kinds, scenarios), strict=True))
    return mean, error_of(numbers, SHARE if set(numbers) <= {0.0, 1.0} else "mean", kinds, scenarios)


def paid_s(requests: Requests, mean_s: float, use: ResourceUse | None, rules: RecordRules) -> float:
    """Return the time that is paid for each valid request: while one is open, and of the node's own work between them."""
    open_s, n = requests.busy_s(mean_s), len(requests.latencies_s)
    if use is None or rules.workload:
        return open_s
    return max(open_s, min(open_s + between_s(use, requests.open_s, n), use.window / n))
