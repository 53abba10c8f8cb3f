"""How far a statistic of a sample's requests may be from that of ever more requests.

Successive requests resemble each other, so the error is that of batches: the requests in order, in `BATCHES` batches, or the
root of their number if that is more; the lag-1 autocorrelation of the batches widens it further. It is never smaller than
that of independent requests. Each scenario has its own, and they are joined by their weights. What did not occur in a sample,
no interval knows: an event of once in as many requests, or phases that last for a third of it.
"""

import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

SHARE = "share"  # the mean of ones and zeros
QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99}
LEVEL, STRICT, USUAL = 0.95, 0.99, 0.9  # two-sided
BATCHES = 30
LEAST = 5  # values of each kind
LEAST_IN_ORDER = 10  # values; whether fewer resemble each other cannot be told
LEAST_INDEPENDENT = 4.0  # batches; correlation of fewer cannot be told from a trend
CAUTION = 0.5  # standard errors by which the autocorrelation is taken larger than estimated
MOST_CORRELATION = 0.99
ROUNDING = 1e-9  # of sums of weights

Parts = Sequence[tuple[float, Sequence[float]]]  # the values of each kind, in the order they came, and its weight


class Interval(NamedTuple):
    """The statistic, and the ends of its interval, in the unit of the values: infinite for too few of them."""

    value: float
    low: float
    high: float

    @property
    def half(self) -> float:
        """Return half of its width."""
        return (self.high - self.low) / 2


class _Error(NamedTuple):
    """The standard error of a mean, from how many independent batches it is, and how skewed that mean is."""

    size: float
    batches: float
    skewness: float


def interval(
    values: Sequence[float],
    statistic: str,
    level: float = LEVEL,
    kinds: Sequence[str] = (),
    weights: Mapping[str, float] | None = None,
) -> Interval:
    """Return the statistic of at least one value, in the order they came, and its interval with a confidence of `level`.

    With `weights` of kinds, values are of these `kinds`. Mean and share of ones: Student's t. Quantiles: order statistics. Ends
    are infinite for fewer than `LEAST` values of a kind, for values that resemble each other so much that they are worth
    fewer than `LEAST_INDEPENDENT`, and for a quantile beyond which too few values lie.
    """
    parts, share = _parts(values, kinds, weights or {}), QUANTILES.get(statistic)
    if share is not None:
        return _of_quantile(parts, share, level)
    value = math.fsum(weight * statistics.fmean(part) for weight, part in parts if part)
    error = _joined([(weight, part, _least(part, statistic == SHARE)) for weight, part in parts])
    if error is None:
        return Interval(value, -math.inf, math.inf)
    wide = _student(level, error.batches - 1)
    # Of a skewed latency, few values miss the rare end: Johnson's correction, on that side only.
    missed = error.skewness / 6 * (1 + 2 * wide * wide)
    low, high = (
        value + error.size * (sign * wide + extra) for sign, extra in ((-1, min(missed, 0.0)), (1, max(missed, 0.0)))
    )
    return Interval(value, low, high)


def error_of(
    values: Sequence[float], statistic: str, kinds: Sequence[str] = (), weights: Mapping[str, float] | None = None
) -> float:
    """Return the standard error of the logarithm of a statistic, infinite where nothing can be said.

    That is the normal law's whose range of `USUAL` confidence is as wide as the wider side of the interval.
    """
    value, low, high = interval(values, statistic, USUAL, kinds, weights)
    if low <= 0 or math.isinf(high):
        return math.inf
    return math.log(max(high / value, value / low)) / statistics.NormalDist().inv_cdf((1 + USUAL) / 2)


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


def _parts(values: Sequence[float], kinds: Sequence[str], weights: Mapping[str, float]) -> Parts:
    """Return the values by kind, whose weights sum to 1 over the kinds that occur."""
    if not weights:
        return [(1.0, values)]
    by_kind: dict[str, list[float]] = {kind: [] for kind in weights}
    for value, kind in zip(values, kinds, strict=True):
        if kind in by_kind:
            by_kind[kind].append(value)
    total = math.fsum(weights[kind] for kind, part in by_kind.items() if part)
    return [(weights[kind] / total, part) for kind, part in by_kind.items()]


def _of_quantile(parts: Parts, share: float, level: float) -> Interval:
    pairs = sorted((one, weight / len(part)) for weight, part in parts for one in part)
    value = quantile(pairs, share)
    below = [(weight, [1.0 if one < value else 0.0 for one in part]) for weight, part in parts]
    known = math.sqrt(share * (1 - share) / len(pairs)) if len(parts) == 1 else None
    error = _joined([(weight, part, _least(part, share=True) if known is None else known) for weight, part in below])
    wide = math.inf if error is None else _student(level, error.batches - 1) * error.size
    if not (share - wide >= 0 and share + wide <= 1):
        return Interval(value, -math.inf, math.inf)
    before, low, high = 0.0, pairs[0][0], pairs[-1][0]
    for one, own in pairs:
        if before <= share - wide + ROUNDING:
            low = one
        before += own
        if before >= share + wide - ROUNDING:
            high = one
            break
    return Interval(value, min(low, value), max(high, value))


def _least(values: Sequence[float], share: bool = False) -> float:
    """Return the standard error of the mean of independent values; of a share of ones, by the rule of succession."""
    n = len(values)
    if n < LEAST:
        return math.inf
    if share:
        ones = (math.fsum(values) + 1) / (n + 2)
        return math.sqrt(ones * (1 - ones) / n)
    return statistics.stdev(values) / math.sqrt(n)


def _joined(parts: Sequence[tuple[float, Sequence[float], float]]) -> _Error | None:
    """Return the error of the weighted mean of parts with the `least` error of each; None where nothing can be said.

    Its degrees of freedom are those of Welch and Satterthwaite.
    """
    errors = [(weight, _error(values, least)) for weight, values, least in parts]
    known = [(weight * one.size, one) for weight, one in errors if one is not None]
    if len(known) < len(parts):
        return None
    size = math.hypot(*(own for own, _ in known))
    if not size:
        return _Error(0.0, min(one.batches for _, one in known), 0.0)
    return _Error(
        size,
        1 + 1 / math.fsum((own / size) ** 4 / (one.batches - 1) for own, one in known),
        math.fsum((own / size) ** 3 * one.skewness for own, one in known),
    )


def _error(values: Sequence[float], least: float) -> _Error | None:
    """Return the error of the mean of values, `least` or more; None for too few."""
    n = len(values)
    if n < LEAST:
        return None
    count = min(n, max(BATCHES, math.isqrt(n)))
    edges = [n * number // count for number in range(count + 1)]
    batches = [statistics.fmean(values[start:end]) for start, end in itertools.pairwise(edges)]
    mean = statistics.fmean(values)
    off = [batch - mean for batch in batches]
    square = math.fsum(one * one for one in off)
    if not square:
        return _Error(least, count, 0.0)
    lag = 0.0
    if n >= LEAST_IN_ORDER:
        lag = math.fsum(a * b for a, b in itertools.pairwise(off)) / square
        lag = (lag + 1 / count) / (1 - 4 / count)  # without its bias, as the mean is estimated, too
        lag += CAUTION * math.sqrt(max(0.0, 1 - lag * lag) / count)
        lag = min(max(lag, 0.0), MOST_CORRELATION)
    longer = (1 + lag) / (1 - lag)
    if count / longer < LEAST_INDEPENDENT:
        return None
    deviation = math.sqrt(square / count)
    skewness = math.fsum((one / deviation) ** 3 for one in off) / count
    size = max(least, math.sqrt(square / (count - 1) / count * longer))
    return _Error(size, count / longer, skewness / math.sqrt(count / longer))


def _student(level: float, freedom: float) -> float:
    """Return the two-sided quantile of Student's t for 3 or more degrees of freedom, within 4% (Cornish-Fisher)."""
    z = statistics.NormalDist().inv_cdf((1 + level) / 2)
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + first / freedom + second / freedom**2 + third / freedom**3
