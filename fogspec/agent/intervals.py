"""The interval of a latency: how far the statistic of a sample's requests may be from that of ever more requests.

Successive requests resemble each other, so the error is that of batches: the requests in order, in `BATCHES` batches, or the
root of their number if that is more; the lag-1 autocorrelation of the batches widens it further. It is never smaller than
that of independent requests.
"""

import itertools
import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple

QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99}
LEVEL, STRICT = 0.95, 0.99  # two-sided
BATCHES = 30
LEAST = 10  # requests
LEAST_INDEPENDENT = 4.0  # batches; correlation of fewer cannot be told from a trend
CAUTION = 0.5  # standard errors by which the autocorrelation is taken larger than estimated
MOST_CORRELATION = 0.99


class Interval(NamedTuple):
    """The statistic, the ends of its interval and its standard error, in the unit of the values.

    Ends and error are infinite for too few values.
    """

    value: float
    low: float
    high: float
    error: float

    @property
    def half(self) -> float:
        """Return half of its width."""
        return (self.high - self.low) / 2


def interval(values: Sequence[float], statistic: str, level: float = LEVEL) -> Interval:
    """Return the statistic of at least one value, in the order they came, and its interval with a confidence of `level`.

    Mean: Student's t. Quantiles: order statistics. Its ends are infinite for fewer than `LEAST` values, for values that
    resemble each other so much that they are worth fewer than `LEAST_INDEPENDENT`, and for a quantile beyond which too
    few values lie.
    """
    share = QUANTILES.get(statistic)
    if share is not None:
        return _of_quantile(values, share, level)
    value = statistics.fmean(values)
    errors = _errors(values, statistics.stdev(values) / math.sqrt(len(values))) if len(values) >= LEAST else None
    if errors is None:
        return Interval(value, -math.inf, math.inf, math.inf)
    error, batches, skewness = errors
    wide = _student(level, batches - 1)
    # Of a skewed latency, few values miss the rare end: Johnson's correction, on that side only.
    missed = skewness / math.sqrt(batches) / 6 * (1 + 2 * wide * wide)
    low, high = (
        value + error * (sign * wide + extra) for sign, extra in ((-1, min(missed, 0.0)), (1, max(missed, 0.0)))
    )
    return Interval(value, low, high, error)


def _of_quantile(values: Sequence[float], share: float, level: float) -> Interval:
    n, ordered = len(values), sorted(values)
    value = at_share(ordered, share)
    unknown = Interval(value, -math.inf, math.inf, math.inf)
    below = [1.0 if one < value else 0.0 for one in values]
    errors = _errors(below, math.sqrt(share * (1 - share) / n)) if n >= LEAST else None
    if errors is None:
        return unknown
    error, batches, _ = errors
    wide = _student(level, batches - 1)
    first, last = math.floor(n * (share - wide * error)), math.ceil(n * (share + wide * error))
    if first < 0 or last >= n:
        return unknown
    low, high = ordered[first], ordered[last]
    return Interval(value, low, high, (high - low) / 2 / wide)


def at_share(ordered: Sequence[float], share: float) -> float:
    """Return the quantile of ordered values, linear between them."""
    below = math.floor(share * (len(ordered) - 1))
    rest = share * (len(ordered) - 1) - below
    return ordered[below] + rest * (ordered[min(below + 1, len(ordered) - 1)] - ordered[below])


def independent(values: Sequence[float]) -> float:
    """Return how many independent values would tell the mean as exactly as these, which came in this order."""
    n = len(values)
    if n < LEAST or not (alone := statistics.stdev(values) / math.sqrt(n)):
        return float(n)
    errors = _errors(values, alone)
    return n * (alone / errors[0]) ** 2 if errors else LEAST_INDEPENDENT


def _errors(values: Sequence[float], least: float) -> tuple[float, float, float] | None:
    """Return the standard error of the mean of at least `LEAST` values, `least` or more, and what it rests on.

    That is how many independent batches those are worth, and their skewness. None for too few.
    """
    n = len(values)
    count = min(n, max(BATCHES, math.isqrt(n)))
    edges = [n * number // count for number in range(count + 1)]
    batches = [statistics.fmean(values[start:end]) for start, end in itertools.pairwise(edges)]
    mean = statistics.fmean(values)
    off = [batch - mean for batch in batches]
    square = math.fsum(one * one for one in off)
    if not square:
        return least, count, 0.0
    lag = math.fsum(a * b for a, b in itertools.pairwise(off)) / square
    lag = (lag + 1 / count) / (1 - 4 / count)  # without its bias, as the mean is estimated, too
    lag += CAUTION * math.sqrt(max(0.0, 1 - lag * lag) / count)
    lag = min(max(lag, 0.0), MOST_CORRELATION)
    longer = (1 + lag) / (1 - lag)
    if count / longer < LEAST_INDEPENDENT:
        return None
    skewness = math.fsum(one**3 for one in off) / count / (square / count) ** 1.5
    return max(least, math.sqrt(square / (count - 1) / count * longer)), count / longer, skewness


def _student(level: float, freedom: float) -> float:
    """Return the two-sided quantile of Student's t for 3 or more degrees of freedom, within 4% (Cornish-Fisher)."""
    z = statistics.NormalDist().inv_cdf((1 + level) / 2)
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + first / freedom + second / freedom**2 + third / freedom**3
