"""The stopping rule: count a sample's requests as they are written, and decide whether there are enough."""

import contextlib
import itertools
import json
import math
import re
import statistics
from pathlib import Path

from .files import open_plain, truncate

TIMINGS_LIMIT = 256 * 2**20
READ_BYTES = 2**18
LINE_LIMIT = 2**16
NOT_REQUESTS = {"unmatched", "metric", "note", "warning"}
OTHER_NAMES = 5
FIRST_CHECK = 10  # valid requests before the precision is checked
QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99}
Z95 = 1.959964  # two-sided 95% quantile of the standard normal distribution
Z99 = 2.575829


class Timings:
    """The growing file of records; an incomplete last line is left until it is complete."""

    def __init__(self, path: Path, warmup: int, callback: str | None = None) -> None:
        self.path, self.warmup, self.callback = path, warmup, callback
        self.offset = self.requests = self.unreadable = 0
        self.next_check = FIRST_CHECK
        self.valid: list[float] = []
        self.rest = b""
        self.note: str | None = None
        self.others: dict[str, None] = {}
        self.awaited = callback is not None  # no request of its name has started

    def read(self) -> bool:
        """Read new records; return True if there was at least one complete request."""
        before = self.requests
        with contextlib.suppress(OSError), open(open_plain(self.path), "rb") as file:
            file.seek(self.offset)
            # Python allocates the size of each read, and the memory is the workload's.
            while new := file.read(min(READ_BYTES, TIMINGS_LIMIT - self.offset)):
                self.offset += len(new)
                *lines, self.rest = (self.rest + new).split(b"\n")
                for line in filter(None, lines):
                    self._take(line)
                if len(self.rest) > LINE_LIMIT:  # longer than any record
                    self.rest, self.unreadable = b"", self.unreadable + 1
        return self.requests > before

    def cut(self) -> None:
        """Truncate the file to what was read: a request that was interrupted by ending its process did not fail."""
        truncate(self.path, self.offset - len(self.rest))

    def _take(self, line: bytes) -> None:
        try:
            record = json.loads(line)
            if NOT_REQUESTS & record.keys():
                self.note = str(record["note"])[:200] if "note" in record else self.note
                self.awaited = self.awaited and record.get("started") != self.callback
                return
            latency_s, ok = float(record["latency_s"]), record["ok"] is True
            if not 0 <= latency_s < math.inf:
                raise ValueError(latency_s)
        except (ArithmeticError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self.unreadable += 1
            return
        if self.callback is not None and record.get("name") != self.callback:
            if self.awaited and len(self.others) < OTHER_NAMES:
                self.others[str(record.get("name"))[:100]] = None
            return
        self.awaited = False
        self.requests += 1
        if ok and self.requests > self.warmup:
            self.valid.append(latency_s)

    def misnamed(self) -> tuple[str, bool] | None:
        """Return why no request counts if others are timed and the spec's was not even started, and whether by a slip."""
        if not self.awaited or not self.others:
            return None
        timed = ", ".join(map(repr, self.others))
        slip = any(mistyped(str(self.callback), name) for name in self.others)
        return f"no request named {self.callback!r} was timed, only {timed}", slip

    def summary(self) -> str:
        """Return the number of requests and the mean latency of the valid ones, as text."""
        mean = f", mean {statistics.fmean(self.valid):.6g} s" if self.valid else ""
        return f"{self.requests} requests{mean}"

    def due(self) -> bool:
        """Return whether to check the precision: after every 5% more requests, because that sorts all of them."""
        if len(self.valid) < self.next_check:
            return False
        self.next_check = math.ceil(len(self.valid) * 1.05) + 1
        return True

    def precise(self, precision: float, statistic: str) -> bool:
        """Return whether the half-width of the 95% interval is at most `precision` times the statistic."""
        value, half = interval(self.valid, statistic)
        return half <= precision * value

    def above(self, latency_s: float, statistic: str) -> bool:
        """Return whether the statistic is above this latency: the lower end of its 99% interval is."""
        value, half = interval(self.valid, statistic, Z99)
        return value - half > latency_s


def mistyped(one: str, other: str) -> bool:
    """Return whether two names differ only in case and separators, or in one letter left out, added, changed or swapped.

    Names that differ in a digit, such as `plan_1` and `plan_2`, are two names.
    """
    a, b = (re.sub(r"[^a-z0-9]", "", name.lower()) for name in (one, other))
    while a and b and a[0] == b[0]:
        a, b = a[1:], b[1:]
    while a and b and a[-1] == b[-1]:
        a, b = a[:-1], b[:-1]
    swapped = len(a) == 2 and a == b[::-1]
    return not re.search(r"\d", a + b) and (swapped or max(len(a), len(b)) <= 1)


def interval(values: list[float], statistic: str, z: float = Z95) -> tuple[float, float]:
    """Return the statistic of at least 10 values and the half-width of its interval: of 95%, or with this normal quantile `z`.

    Mean: Student's t (Cornish-Fisher expansion of its quantile). Quantiles: binomial order statistics; infinite while
    the upper one does not exist. Both are widened by the lag-1 autocorrelation, of the values or of the indicator of
    being below the quantile, because successive requests are correlated.
    """
    n = len(values)
    if statistic in QUANTILES:
        share = QUANTILES[statistic]
        ordered = sorted(values)
        value = ordered[math.floor(n * share)]
        below = [1.0 if one < value else 0.0 for one in values]
        spread = z * math.sqrt(n * share * (1 - share)) * widening(below)
        low, high = math.floor(n * share - spread), math.ceil(n * share + spread)
        half = (ordered[high] - ordered[low]) / 2 if low >= 0 and high < n else math.inf
        return value, half
    mean = statistics.fmean(values)
    square = math.fsum((value - mean) ** 2 for value in values)
    v = n - 1
    t = z + (z**3 + z) / (4 * v) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * v**2)
    return mean, t * math.sqrt(square / v / n) * widening(values)


def widening(values: list[float]) -> float:
    """Return the ratio of an interval's width to that of independent values, from the lag-1 autocorrelation."""
    mean = statistics.fmean(values)
    square = math.fsum((value - mean) ** 2 for value in values)
    if square == 0:
        return 1.0
    lag = math.fsum((a - mean) * (b - mean) for a, b in itertools.pairwise(values)) / square
    lag = min(max(lag, 0.0), 0.99)
    return math.sqrt((1 + lag) / (1 - lag))
