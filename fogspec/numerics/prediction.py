"""The distribution of what a workload takes on each machine that could be rented: range, probability and gate read it alone.

The logarithm of the value on another server of the machine's type is a mixture of two normals,
(1 - tail) N(mu, sigma²) + tail N(mu, sigma² + spread²): `mu` and `sigma` are what the samples say of the type, `tail` and
`spread` how servers of one type differ in its cloud (`fogspec.numerics.servers`). Without them it is the server that was
measured.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np

from fogspec.numerics.kernels import Floats, quantised
from fogspec.numerics.normal import normal_cdf_and_density, normal_quantile
from fogspec.numerics.waiting import Waiting

MOST_STEPS = 60  # of Newton's method, which takes about five
PRECISION = 1e-10  # of a quantile, in standard deviations
LONGEST_LOG = 600.0  # what an exponential can hold: a lower bound alone may leave everything open


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted log values of N machines, each column (N,): mean and standard deviation, and the shift between servers.

    `mu` is of a latency in seconds or of a metric in its own unit. Numbers have nine significant digits. With `waiting`,
    the columns are of requests one after the other, and value, probability and range are of the latency at its rate.
    """

    mu: Floats
    sigma: Floats
    tail: Floats
    spread: Floats
    waiting: Waiting | None = None

    @property
    def on_measured_server(self) -> "Prediction":
        """The same without the shift between servers."""
        none = np.zeros_like(self.mu)
        return replace(self, tail=none, spread=none)

    @property
    def alone(self) -> "Prediction":
        """The same of requests one after the other."""
        return replace(self, waiting=None)

    @property
    def value(self) -> Floats:
        """The median (N,), in seconds or the metric's unit."""
        return self._at_rate(np.exp(np.clip(self.mu, -LONGEST_LOG, LONGEST_LOG)))

    def take(self, rows: np.ndarray) -> "Prediction":
        """Return the prediction of the machines at these indices."""
        columns = self.mu[rows], self.sigma[rows], self.tail[rows], self.spread[rows]
        return Prediction(*columns, None if self.waiting is None else self.waiting.take(rows))

    def widened(self, factor: Floats | float) -> "Prediction":
        """Return the prediction with `sigma` multiplied by a factor, a number or (N,)."""
        return replace(self, sigma=quantised(self.sigma * factor))

    def covers(self, log_value: Floats, level: float) -> np.ndarray:
        """Return whether log values (N,) lie in the two-sided range that has them with this probability."""
        below = self._below((log_value - self.mu) / self.sigma)[0]
        return np.asarray(np.abs(below - 0.5) <= level / 2)

    def probability_below(self, bound: Floats | float) -> Floats:
        """Return the probability (N,) that the value is at most the bound, a number or (N,): 1 for infinity, 0 for <= 0."""
        if self.waiting is not None:
            bound = self.waiting.alone(np.broadcast_to(bound, self.mu.shape))
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (np.log(np.maximum(bound, 0.0)) - self.mu) / self.sigma
        return quantised(self._below(z)[0])

    def quantile(self, p: Floats | float) -> Floats:
        """Return the value (N,) that is not exceeded with probability p, a number or (N,).

        Raise ValueError for a probability outside 0 to 1.
        """
        if not np.all((np.asarray(p) > 0) & (np.asarray(p) < 1)):
            raise ValueError(f"a probability lies between 0 and 1, got {p}")
        log = self.mu + self.sigma * self._root(np.broadcast_to(p, self.mu.shape))
        return self._at_rate(np.exp(np.clip(log, -LONGEST_LOG, LONGEST_LOG)))

    def interval(self, level: float) -> tuple[Floats, Floats]:
        """Return the ends (N,) of the two-sided range that has the value with this probability; they are computed once."""
        if level not in self._intervals:
            self._intervals[level] = self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)
        return self._intervals[level]

    @functools.cached_property
    def _intervals(self) -> dict[float, tuple[Floats, Floats]]:
        return {}

    def room(self, level: float) -> Floats:
        """Return how far below a bound (N,) a measured machine must lie, as a logarithm, for another server to hold it."""
        beyond = np.maximum(level - (1 - self.tail), 0.0) / np.where(self.tail > 0, self.tail, 1.0)
        return np.where(beyond > 0.5, self.spread * normal_quantile(np.clip(beyond, 1e-12, 1 - 1e-12)), 0.0)

    def _at_rate(self, values: Floats) -> Floats:
        return quantised(values) if self.waiting is None else self.waiting.at_rate(quantised(values))

    def _below(self, z: Floats) -> tuple[Floats, Floats]:
        """Return the probability (N,) of at most `z` standard deviations above the mean, and the density there."""
        wide = np.hypot(1.0, self.spread / self.sigma)
        (below, density), (of_tail, density_of_tail) = normal_cdf_and_density(z), normal_cdf_and_density(z / wide)
        return (
            (1 - self.tail) * below + self.tail * of_tail,
            (1 - self.tail) * density + self.tail * density_of_tail / wide,
        )

    def _root(self, p: Floats) -> Floats:
        """Return the standard deviations (N,) from the mean that are not exceeded with probability p.

        Above the mean the probability is concave, and the quantile of the narrow part lies below that of both: from there
        Newton's method rises to the root. Below the mean it is the mirror image.
        """
        upper = np.maximum(p, 1 - p)
        z = normal_quantile(upper)
        active = np.flatnonzero(self.tail > 0)
        for _ in range(MOST_STEPS):
            if not len(active):
                break
            below, density = self.take(active)._below(z[active])
            step = (upper[active] - below) / density
            z[active] += step
            active = active[step > PRECISION]
        return np.where(p < 0.5, -z, z)
