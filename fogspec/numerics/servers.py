"""Differences between servers: the latency of one workload on another server of the same instance type.

With probability `tail` the log-latency of a program on the next server is off by a normal variable of standard deviation
`spread`: another CPU, or busy neighbours. Otherwise it is as on the one that was measured, within the error of a sample.

Source: Spare Cores' public results of 2024 to 2026 (SpareCores/sc-inspector-data at 804d3c71), consecutive runs of one
benchmark on one type more than a day apart, each score a program: 25,876 pairs on 369 types of AWS, 2,394 on 63 of Azure.
Fitted by `python -m fogspec_lab.servers`, and scored on types kept out of the fit (ADR 0023): see there. Some differences
may be newer builds of a benchmark: they are upper bounds. Other clouds are taken to be between the two. Machines of one's own
(this host, Slurm, Kubernetes, ssh) have no shift until repeats show one.
"""

import math
from dataclasses import dataclass

import numpy as np

from fogspec.numerics.kernels import Floats, Ints, codes


@dataclass(frozen=True, slots=True)
class Shift:
    """The distribution of the shift of log-latency: the probability that there is one, and its standard deviation."""

    tail: float
    spread: float

    def beyond(self, size: float) -> float:
        """Return the probability that the shift is larger than `size`, up or down."""
        return self.tail * math.erfc(size / self.spread / math.sqrt(2)) if self.tail else 0.0


NONE = Shift(tail=0.0, spread=0.0)
SHIFTS = {
    "aws": Shift(tail=0.333, spread=0.083),
    "azure": Shift(tail=0.518, spread=0.119),
    **dict.fromkeys(("local", "slurm", "kubernetes", "ssh"), NONE),
}
OTHER = Shift(tail=0.425, spread=0.101)


def shifts_of(cloud: Ints) -> tuple[Floats, Floats]:
    """Return tail and spread (N,) of machines by the code of their cloud (N,)."""
    known = dict(zip(codes(list(SHIFTS)).tolist(), SHIFTS.values(), strict=True))
    clouds, of = np.unique(cloud, return_inverse=True)
    each = [known.get(code, OTHER) for code in clouds.tolist()]
    tail, spread = np.array([(one.tail, one.spread) for one in each]).reshape(-1, 2).T[:, of.ravel()]
    return tail, spread
