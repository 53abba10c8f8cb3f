"""Nested shapes: what a machine confined to its half, quarter or eighth tells of the smaller types of its family.

Such a measurement is an observation of the smaller type with an error of its own: the smaller machine has another share of
caches, memory bandwidth and turbo, and may be another server.

Source of the errors: N workers of a CPU-bound program on a family's biggest machine against the N-vCPU machine with all of
its vCPUs, Spare Cores' public results (SpareCores/sc-inspector-data at 804d3c71). With one vCPU per core (60 pairs): median
0.33%, 90th percentile 3.7%. With two (39 pairs): 3.6% and 17%. They say nothing of programs bound by memory or I/O: a
campaign learns its own error from the types that it measured both ways.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fogspec.numerics.kernels import Floats, Machines

PARTS = (2, 4, 8)
NORMAL_90 = 1.645  # absolute value of a standard normal variable that is not exceeded with probability 0.9
NORMAL_80 = 1.2816  # a standard normal variable that is not exceeded with probability 0.9
# Absolute error of log-latency, with one vCPU per core and with two: median and 90th percentile.
MEDIAN_ALONE, MEDIAN_SHARED = 0.0033, 0.036
P90_ALONE, P90_SHARED = 0.037, 0.17
SAME_MEMORY = 0.1  # relative difference of the memory per vCPU beyond which a smaller type is not a part of the machine
SAMPLES_OF_SOURCE = 4.0  # what the source counts for, in pairs of the campaign's own
NOT_ASKED_AGAIN = 0.5  # the probability that a type that was measured as a part need not be measured itself


@dataclass(frozen=True, slots=True)
class Parts:
    """What the parts of each of N machines stand for: `rows` of machines, half, quarter and eighth as far as there are such.

    A part adds `share` of the price of a sample; `error` (N,) is the relative standard error of a machine's latency measured as
    a part of a larger one.
    """

    rows: Sequence[Sequence[int]]
    share: float
    error: Floats

    @classmethod
    def of(cls, machines: Machines, share: float) -> "Parts":
        """Return the parts of these machines."""
        return cls(nested_rows(machines), share, nested_error(machines))

    def worth(self, machine: int, cost: Floats, variance: Floats, wanted: np.ndarray) -> tuple[int, ...]:
        """Return the parts of a machine that are worth measuring with it: those of `wanted` (N,) machines that cost less so.

        A part saves the sample of the machine that it stands for as often as it tells enough; `cost` (N,) is that of a
        sample of each, `variance` (N,) that of their log-latency now.
        """
        told = variance / (variance + self.error**2)
        price = self.share * cost[machine]
        return tuple(
            one for one in self.rows[machine] if wanted[one] and price < NOT_ASKED_AGAIN * told[one] * cost[one]
        )


def nested_rows(machines: Machines) -> list[tuple[int, ...]]:
    """Return for each of N machines the rows of the types that are its half, quarter and eighth, as far as there are such.

    A part has the machine's cloud, family and CPU, that share of its vCPUs, and as much memory per vCPU. Machines with
    accelerators, and those of unknown family, have none.
    """
    known = (machines.family >= 0) & (machines.gpu < 0) & ~machines.burstable
    ratio = machines.memory_gib / machines.vcpus
    kinds = np.column_stack([machines.cloud, machines.family, machines.arch, machines.cpu_model])
    rows: dict[tuple[tuple[int, ...], float], list[int]] = {}
    for row in np.flatnonzero(known).tolist():
        rows.setdefault((tuple(kinds[row].tolist()), float(machines.vcpus[row])), []).append(row)
    found: list[tuple[int, ...]] = [()] * len(machines)
    for row in np.flatnonzero(known).tolist():
        parts = []
        for part in PARTS:
            same = rows.get((tuple(kinds[row].tolist()), float(machines.vcpus[row]) / part), [])
            alike = [one for one in same if abs(ratio[one] / ratio[row] - 1) <= SAME_MEMORY]
            parts += alike[:1]
        found[row] = tuple(parts)
    return found


def nested_error(machines: Machines) -> Floats:
    """Return the relative standard error of a nested measurement of each type (N,); types of unknown cores count as shared."""
    return np.where(one_thread_per_core(machines), P90_ALONE, P90_SHARED) / NORMAL_90


def one_thread_per_core(machines: Machines) -> np.ndarray:
    """Return which machines (N,) are known to have one vCPU per core."""
    return np.asarray(machines.vcpus == machines.physical_cores)


def learnt_factor(deviations: Sequence[float], errors: Sequence[float]) -> float:
    """Return by what factor the campaign's own nested measurements err more or less than the source's.

    `deviations` are log-ratios of nested to own measurements of one type, `errors` the standard errors expected of them.
    """
    ratio = sum((one / error) ** 2 for one, error in zip(deviations, errors, strict=True))
    return float(np.sqrt((SAMPLES_OF_SOURCE + ratio) / (SAMPLES_OF_SOURCE + len(deviations))))
