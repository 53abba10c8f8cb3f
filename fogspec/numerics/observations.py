"""Observations: latencies with their errors, replicates, and lower bounds from aborted runs."""

from dataclasses import dataclass

import numpy as np

from fogspec.numerics.kernels import Floats, distinct

DEFAULT_NOISE = 0.025  # relative standard error of a sample without a known one
SYSTEMATIC_NOISE = 0.008  # relative difference between machines of one type, however many requests were timed
TYPICAL_NOISE = 0.015  # median of a machine's relative noise, which is heavy-tailed: see `fogspec.numerics.replicates`
NOISE_SPREAD = 0.95  # standard deviation of its logarithm
SCALES = np.linspace(-1.5, 3.0, 8)  # grid of the noise, in these standard deviations from the median


@dataclass(frozen=True, slots=True)
class Observations:
    """n samples: index of the machine, latency, and its error.

    `relative_error` is the standard error of the latency over the latency, NaN if unknown. A `lower_bound` is a run that
    was aborted or failed after that time: the latency is at least this. Raise ValueError for latencies that are not positive
    and finite, for negative errors, and for unequal lengths.
    """

    machine: np.ndarray
    latency_s: Floats
    relative_error: Floats
    lower_bound: np.ndarray

    def __post_init__(self) -> None:
        if len({len(getattr(self, name)) for name in self.__slots__}) > 1:
            raise ValueError(f"{', '.join(self.__slots__)} must have one length")
        bad = ~(np.isfinite(self.latency_s) & (self.latency_s > 0))
        if bad.any():
            where = int(np.flatnonzero(bad)[0])
            raise ValueError(f"sample {where}: latency must be positive and finite, got {self.latency_s[where]} s")
        if bool((self.relative_error < 0).any()):
            raise ValueError("relative_error must not be negative")

    def in_order(self) -> "Observations":
        """Return the samples in an order of their own values, so that sums over them do not depend on the given order."""
        order = np.lexsort((self.lower_bound, self.relative_error, self.latency_s, self.machine))
        return Observations(*(getattr(self, name)[order] for name in self.__slots__))

    @property
    def own(self) -> np.ndarray:
        """The complete samples, (n,)."""
        return np.asarray(~self.lower_bound)


def observations(
    machine: np.ndarray | list[int],
    latency_s: np.ndarray | list[float],
    relative_error: np.ndarray | list[float] | None = None,
    lower_bound: np.ndarray | list[bool] | None = None,
) -> Observations:
    """Return `Observations` from sequences; by default errors are unknown and no run was aborted."""
    n = len(machine)
    return Observations(
        np.asarray(machine, dtype=np.intp).reshape(n),
        np.asarray(latency_s, dtype=float).reshape(n),
        np.full(n, np.nan) if relative_error is None else np.asarray(relative_error, dtype=float),
        np.zeros(n, dtype=bool) if lower_bound is None else np.asarray(lower_bound, dtype=bool),
    )


def pooled(samples: Observations) -> tuple[np.ndarray, Floats, Floats]:
    """Return the complete samples pooled by machine: index, mean log-latency, and variance of its error, each (M,).

    Replicates are weighted by their precision. How noisy a machine is, its replicates tell: their error is the average over
    the heavy-tailed distribution of noise given how far they are apart.
    """
    use = ~samples.lower_bound
    known, relative = ~np.isnan(samples.relative_error[use]), samples.relative_error[use]
    variance = np.where(known, relative, DEFAULT_NOISE) ** 2 + SYSTEMATIC_NOISE**2
    typical = np.where(known, variance, TYPICAL_NOISE**2)
    log = np.log(samples.latency_s[use])
    machines = distinct(samples.machine[use])
    value, error_variance = np.empty(len(machines)), np.empty(len(machines))
    for i, machine in enumerate(machines):
        mine = samples.machine[use] == machine
        precision = 1 / variance[mine]
        value[i] = (precision * log[mine]).sum() / precision.sum()
        error_variance[i] = 1 / precision.sum()
        if mine.sum() > 1:
            error_variance[i] = _replicated_variance(log[mine] - value[i], typical[mine])
    return machines, value, error_variance


def _replicated_variance(deviation: Floats, typical: Floats) -> float:
    """Return the variance of the mean of replicates (n,) whose noise is `typical` (n,) times an unknown factor."""
    factor = np.exp(2 * NOISE_SPREAD * SCALES)
    chi2 = float((deviation**2 / typical).sum())
    log = -0.5 * (SCALES**2 + chi2 / factor + (len(deviation) - 1) * np.log(factor))
    weight = np.exp(log - log.max())
    return float(weight @ factor / weight.sum() / (1 / typical).sum())


def mean_level(samples: Observations) -> float:
    """Return the mean log-latency of all samples, including lower bounds; 0 for no samples."""
    return float(np.log(samples.latency_s).mean()) if len(samples.latency_s) else 0.0


def lower_bounds(samples: Observations) -> list[tuple[int, float]]:
    """Return the highest lower bound of log-latency of each machine that has one, by machine."""
    highest: dict[int, float] = {}
    for machine, latency in zip(
        samples.machine[samples.lower_bound], samples.latency_s[samples.lower_bound], strict=True
    ):
        highest[int(machine)] = max(highest.get(int(machine), -np.inf), float(np.log(latency)))
    return sorted(highest.items())
