"""Counts a sample's requests while it runs, and says when they are enough. Standard library only, beside agent.py."""

import contextlib
import itertools
import json
import math
import os
import statistics
from pathlib import Path

TIMINGS_LIMIT = 256 * 2**20
READ_BYTES = 2**18
LINE_LIMIT = 2**16
OTHER = {"unmatched", "metric", "note", "warning"}  # records that are no requests


class Timings:
    """The growing file of records; a partial last line is left until it is whole."""

    def __init__(self, path: Path, warmup: int, callback: str | None = None) -> None:
        self.path, self.warmup, self.callback = path, warmup, callback
        self.offset = self.requests = self.unreadable = self.next_look = 0
        self.valid: list[float] = []
        self.rest = b""
        self.note: str | None = None

    def read(self) -> bool:
        """Read what is new; True when there was at least one whole record."""
        before = self.requests
        with contextlib.suppress(FileNotFoundError), open(self.path, "rb", opener=at_once) as file:
            file.seek(self.offset)
            # Python takes the space of what it is asked to read, which is the workload's.
            while new := file.read(min(READ_BYTES, TIMINGS_LIMIT - self.offset)):
                self.offset += len(new)
                *lines, self.rest = (self.rest + new).split(b"\n")
                for line in filter(None, lines):
                    self._take(line)
                if len(self.rest) > LINE_LIMIT:  # no record is so long
                    self.rest, self.unreadable = b"", self.unreadable + 1
        return self.requests > before

    def cut(self) -> None:
        """Drop what was written after the last look: a request that was broken off by ending it did not fail."""
        with contextlib.suppress(OSError):
            os.truncate(self.path, min(self.offset - len(self.rest), self.path.stat().st_size))

    def _take(self, line: bytes) -> None:
        try:
            record = json.loads(line)
            if OTHER & record.keys():
                self.note = str(record["note"])[:200] if "note" in record else self.note
                return
            latency, ok = float(record["latency_s"]), record["ok"] is True
            if not 0 <= latency < math.inf:
                raise ValueError(latency)
        except (ArithmeticError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self.unreadable += 1
            return
        if self.callback is not None and record.get("name") != self.callback:
            return
        self.requests += 1
        if ok and self.requests > self.warmup:
            self.valid.append(latency)

    def so_far(self) -> str:
        """How many requests there were, and the mean latency of the valid ones."""
        mean = f", mean {statistics.fmean(self.valid):.6g} s" if self.valid else ""
        return f"{self.requests} requests{mean}"

    def precise(self, precision: float, statistic: str) -> bool:
        """Whether the 95 % interval is narrower than ± precision; looked at rarely, since it is not free."""
        if len(self.valid) < max(10, self.next_look):
            return False
        self.next_look = math.ceil(len(self.valid) * 1.05) + 1
        value, half = interval(self.valid, statistic)
        return half <= precision * value


def at_once(path: str, flags: int) -> int:
    """Open without waiting: a workload may have put a pipe in the place of its timings."""
    return os.open(path, flags | os.O_NONBLOCK)


def interval(values: list[float], statistic: str) -> tuple[float, float]:
    """The statistic of at least 10 values, and half the width of its 95 % interval.

    Mean: Student's t (Cornish-Fisher expansion of its quantile). Quantiles: binomial order statistics; infinite while
    the upper one does not exist. Both are widened by the lag-1 autocorrelation, of the values or of which of them lie
    below the quantile, since successive requests resemble each other.
    """
    n = len(values)
    if statistic != "mean":
        share = {"p50": 0.5, "p95": 0.95, "p99": 0.99}[statistic]
        ordered = sorted(values)
        value = ordered[math.floor(n * share)]
        below = [1.0 if one < value else 0.0 for one in values]
        spread = 1.959964 * math.sqrt(n * share * (1 - share)) * widening(below)
        low, high = math.floor(n * share - spread), math.ceil(n * share + spread)
        half = (ordered[high] - ordered[low]) / 2 if low >= 0 and high < n else math.inf
        return value, half
    mean = statistics.fmean(values)
    square = math.fsum((value - mean) ** 2 for value in values)
    z, v = 1.959964, n - 1
    t = z + (z**3 + z) / (4 * v) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * v**2)
    return mean, t * math.sqrt(square / v / n) * widening(values)


def widening(values: list[float]) -> float:
    """How much wider an interval is than that of independent values, where each resembles the one before it."""
    mean = statistics.fmean(values)
    square = math.fsum((value - mean) ** 2 for value in values)
    if square == 0:
        return 1.0
    lag = math.fsum((a - mean) * (b - mean) for a, b in itertools.pairwise(values)) / square
    lag = min(max(lag, 0.0), 0.99)
    return math.sqrt((1 + lag) / (1 - lag))
