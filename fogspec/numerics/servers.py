"""Differences between servers: the latency of one workload on another server of the same instance type.

A shift is that of the log-latency from the server that was measured to the one that is rented next, beyond the noise of a
sample: a normal one, and with probability `tail` a wide one, for a server of another CPU, or with busy neighbours.

Source: the median over a server's scores in consecutive runs of one benchmark on one type, Spare Cores' public results of
2024 to 2026 (SpareCores/sc-inspector-data at 804d3c71). AWS, 617 shifts of redis and a static web server: median 0.9%, 90th
percentile 3.9%. Azure, 63 shifts of Geekbench 6: median 2.2%, 90th percentile 15%. Fitted by maximum likelihood to a
mixture of two normals, of which a sample's own noise (`fogspec.numerics.observations`) is a part. Some of the differences
may be newer builds of a benchmark: they are upper bounds. Other clouds are taken to be between the two.
"""

import math
from dataclasses import dataclass

import numpy as np

from fogspec.numerics.kernels import Floats, Ints, codes
from fogspec.numerics.normal import normal_cdf


@dataclass(frozen=True, slots=True)
class Shift:
    """The distribution of the shift of log-latency: standard deviations, and the probability of the wide part."""

    core: float
    tail: float
    spread: float

    def beyond(self, size: float) -> float:
        """Return the probability that the shift is larger than `size`, up or down."""
        parts = ((1 - self.tail, self.core), (self.tail, self.spread))
        return sum(share * math.erfc(size / sd / math.sqrt(2)) for share, sd in parts if sd > 0)


SHIFTS = {
    "aws": Shift(core=0.008, tail=0.094, spread=0.139),
    "azure": Shift(core=0.010, tail=0.407, spread=0.119),
    "local": Shift(core=0.0, tail=0.0, spread=0.0),
}
OTHER = Shift(core=0.009, tail=0.25, spread=0.129)


@dataclass(frozen=True, slots=True)
class Shifts:
    """The shifts of N machines, each (N,): variance of the normal part, probability and variance of the wide part."""

    core: Floats
    tail: Floats
    spread: Floats

    def take(self, rows: np.ndarray) -> "Shifts":
        """Return the shifts at these indices."""
        return Shifts(self.core[rows], self.tail[rows], self.spread[rows])

    def between(self, low: Floats, high: Floats) -> Floats:
        """Return the probability (N,) that the shift lies in this range, NaN where the range is NaN."""
        found = np.zeros(len(low))
        for share, variance in ((1 - self.tail, self.core), (self.tail, self.core + self.spread)):
            # Without a shift the range has it or has it not.
            sd = np.sqrt(np.maximum(variance, 1e-24))
            found += share * (normal_cdf(high / sd) - normal_cdf(low / sd))
        return found


def shifts_of(cloud: Ints) -> Shifts:
    """Return the shifts of machines by the code of their cloud (N,)."""
    known = dict(zip(codes(list(SHIFTS)).tolist(), SHIFTS.values(), strict=True))
    clouds, of = np.unique(cloud, return_inverse=True)
    each = [known.get(code, OTHER) for code in clouds.tolist()]
    core, tail, spread = np.array([(one.core, one.tail, one.spread) for one in each]).reshape(-1, 3).T[:, of.ravel()]
    return Shifts(core**2, tail, spread**2)
