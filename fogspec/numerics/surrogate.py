"""Latency over machines from few samples, with honest uncertainty.

The small, stable interface that everything else calls::

    space = prepare(machines, prior)            # once for a set of machines; prior is optional
    posterior = space.fit(observations)         # after every wave; fit(machines, observations, prior) does both
    posterior.mean, posterior.sd                # log-latency of every machine (N,), measured ones included
    posterior.quantile(0.95)                    # latency_s (N,)
    posterior.probability_below(limit_s)        # (N,), limit_s a number or (N,)
    posterior.measured, posterior.extrapolated  # masks (N,)
    posterior.draws                             # joint draws of log-latency (S, N)
    acquisition.next_wave(posterior, objective, ...) and acquisition.choose(posterior, objective)

Model: log-latency = level + mean curve + Gaussian process, averaged over a grid of mean curves and
hyper-parameters by their evidence instead of picking one (Rasmussen and Williams, Gaussian Processes for Machine
Learning, ch. 2 and 5). Mean curves are Amdahl's law with contention (Gunther's Universal Scalability Law), and,
with a prior, what other workloads do on the same machines. Same inputs give the same numbers: the draws' random
numbers come from a fixed seed.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fogspec.numerics.features import Floats, Machines
from fogspec.numerics.gaussian import normal_cdf, truncated_above_moments
from fogspec.numerics.grid import Grid, grid_with_prior, grid_without_prior

DEFAULT_NOISE = 0.025  # relative standard error of a sample that does not say its own
SYSTEMATIC_NOISE = 0.008  # two machines of one type differ at least by this, however many requests were timed
KEPT_MODELS = 64
DRAWS = 512


@dataclass(frozen=True, slots=True)
class Observations:
    """n samples: which machine, its latency, how sure.

    `relative_error` is the standard error of the latency over the latency, NaN where unknown. A `lower_bound`
    is a run that was aborted or failed after that time: the latency is at least this. Raises ValueError for
    latencies that are not positive and finite, and for negative errors.
    """

    machine: np.ndarray
    latency_s: Floats
    relative_error: Floats
    lower_bound: np.ndarray

    def __post_init__(self) -> None:
        if not len(self.machine) == len(self.latency_s) == len(self.relative_error) == len(self.lower_bound):
            raise ValueError("machine, latency_s, relative_error and lower_bound must have one length")
        bad = ~(np.isfinite(self.latency_s) & (self.latency_s > 0))
        if bad.any():
            where = int(np.flatnonzero(bad)[0])
            raise ValueError(f"sample {where}: latency must be positive and finite, got {self.latency_s[where]} s")
        if bool((self.relative_error < 0).any()):
            raise ValueError("relative_error must not be negative")


def observations(
    machine: np.ndarray | list[int],
    latency_s: np.ndarray | list[float],
    relative_error: np.ndarray | list[float] | None = None,
    lower_bound: np.ndarray | list[bool] | None = None,
) -> Observations:
    """`Observations` from sequences; errors unknown and nothing aborted unless said."""
    n = len(machine)
    return Observations(
        np.asarray(machine, dtype=np.intp).reshape(n),
        np.asarray(latency_s, dtype=float).reshape(n),
        np.full(n, np.nan) if relative_error is None else np.asarray(relative_error, dtype=float),
        np.zeros(n, dtype=bool) if lower_bound is None else np.asarray(lower_bound, dtype=bool),
    )


@dataclass(frozen=True, slots=True)
class Prior:
    """What other workloads do on the same N machines: W log-latency profiles, no cell missing.

    `weight` (W,) says how much each counts (a suite of thirty variants of one program is not thirty
    workloads); `own` (N,) is the variance added where a machine's cells were inferred from similar machines.
    """

    profiles: Floats
    weight: Floats
    own: Floats


@dataclass(frozen=True)
class Posterior:
    """What is known of every machine's log-latency: a mixture of Gaussian processes, weights summing to 1."""

    machines: Machines
    observations: Observations
    weights: Floats
    means: Floats
    variances: Floats
    draws: Floats

    @cached_property
    def mean(self) -> Floats:
        """Mean log-latency (N,)."""
        return np.asarray(self.weights @ self.means)

    @cached_property
    def sd(self) -> Floats:
        """Standard deviation of log-latency (N,)."""
        return np.asarray(np.sqrt(self.weights @ (self.variances + (self.means - self.mean) ** 2)))

    @cached_property
    def measured(self) -> np.ndarray:
        """Machines with at least one complete sample (N,)."""
        mask = np.zeros(len(self.machines), dtype=bool)
        mask[self.observations.machine[~self.observations.lower_bound]] = True
        return mask

    @cached_property
    def extrapolated(self) -> np.ndarray:
        """Machines outside the sampled range of vCPUs or memory, or of a GPU type or architecture not sampled."""
        m, known = self.machines, self.measured
        if not known.any():
            return np.ones(len(m), dtype=bool)
        outside = np.zeros(len(m), dtype=bool)
        for column in (m.vcpus, m.memory_gib):
            outside |= (column < column[known].min()) | (column > column[known].max())
        for code in (m.gpu, m.arch):
            outside |= ~np.isin(code, code[known])
        return np.asarray(outside & ~known)

    def probability_below(self, limit_s: Floats | float) -> Floats:
        """Probability (N,) that latency is at most the limit; a limit of infinity gives 1, of 0 or less gives 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = np.broadcast_to(np.log(np.maximum(limit_s, 0.0)), self.mean.shape)
        return np.asarray(self.weights @ normal_cdf((limit - self.means) / np.sqrt(self.variances)))

    def quantile(self, p: float) -> Floats:
        """Latency in seconds (N,) that is not exceeded with probability p, by bisection on the mixture."""
        if not 0 < p < 1:
            raise ValueError(f"a probability lies between 0 and 1, got {p}")
        low, high = self.mean - 12 * self.sd, self.mean + 12 * self.sd
        root = np.sqrt(self.variances)
        for _ in range(24):
            middle = (low + high) / 2
            below = self.weights @ normal_cdf((middle - self.means) / root) < p
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(np.exp((low + high) / 2))


def prepare(machines: Machines, prior: Prior | None = None, *, seed: int = 0, draws: int = DRAWS) -> "Space":
    """Everything about the machines that does not depend on samples; `draws` joint draws will be made."""
    grid = grid_without_prior(machines) if prior is None else grid_with_prior(machines, prior)
    random = np.random.default_rng(seed)
    base = [random.standard_normal((draws, f.shape[1])) @ f.T for f in grid.features]
    own = random.standard_normal((draws, len(machines)))
    return Space(machines, grid, np.array(base), own, random.standard_normal((draws, len(machines))))


def fit(machines: Machines, samples: Observations, prior: Prior | None = None) -> Posterior:
    """Posterior of one workload's latency on every machine; see `Space.fit`."""
    return prepare(machines, prior).fit(samples)


@dataclass(frozen=True)
class Space:
    """Machines, the grid of models over them, and reusable random draws."""

    machines: Machines
    grid: Grid
    base: Floats
    own: Floats
    errors: Floats

    def fit(self, samples: Observations) -> Posterior:
        """Condition every model of the grid on the samples and weigh it by its evidence."""
        at, value, variance = pooled(samples)
        posterior = self._conditioned(samples, at, value, variance)
        for machine, bound in _bounds(samples):
            site = _site(posterior, machine, bound)
            if site is not None:
                at, value, variance = np.append(at, machine), np.append(value, site[0]), np.append(variance, site[1])
                posterior = self._conditioned(samples, at, value, variance)
        return posterior

    def _conditioned(self, samples: Observations, at: np.ndarray, value: Floats, noise: Floats) -> Posterior:
        grid, level = self.grid, _level(samples)
        if not len(at):
            keep, weights = _kept(np.zeros(len(grid.theta)))
            means = grid.curves[grid.curve[keep]] + level
            variances = grid.theta[keep] @ grid.diagonal + grid.own[keep]
            draws = self._draws(keep, weights, means, at, noise, None)
            return Posterior(self.machines, samples, weights, means, variances, draws)
        cross = np.array([f @ f[at].T for f in grid.features])
        inner = np.tensordot(grid.theta, cross[:, at, :], axes=1)
        same_machine = (at[:, None] == at[None, :]).astype(float)
        inner += (grid.own[:, at])[:, :, None] * same_machine + np.diag(noise)
        inverse = np.linalg.inv(inner)
        residual = value - level - grid.curves[grid.curve][:, at]
        solved = np.einsum("hij,hj->hi", inverse, residual)
        evidence = -0.5 * (residual * solved).sum(1) - 0.5 * np.linalg.slogdet(inner)[1]
        keep, weights = _kept(evidence)
        link = np.tensordot(grid.theta[keep], cross, axes=1)
        link += grid.own[keep][:, :, None] * (np.arange(len(self.machines))[:, None] == at[None, :])
        means = grid.curves[grid.curve[keep]] + level + np.einsum("hni,hi->hn", link, solved[keep])
        explained = ((link @ inverse[keep]) * link).sum(-1)
        total = grid.theta[keep] @ grid.diagonal + grid.own[keep]
        variances = np.maximum(total - explained, 1e-8)
        variances[:, np.isin(np.arange(len(self.machines)), at, invert=True)] *= grid.widened
        draws = self._draws(keep, weights, means, at, noise, (link, inverse[keep]))
        return Posterior(self.machines, samples, weights, means, variances, draws)

    def _draws(
        self, keep: np.ndarray, weights: Floats, means: Floats, at: np.ndarray, noise: Floats,
        conditioning: tuple[Floats, Floats] | None,
    ) -> Floats:  # fmt: skip
        """Joint draws by Matheron's rule: a prior draw plus what its own error at the samples corrects."""
        count = len(self.own)
        which = np.minimum(np.searchsorted(np.cumsum(weights), (np.arange(count) + 0.5) / count), len(weights) - 1)
        out = np.empty((count, len(self.machines)))
        for model in np.unique(which):
            rows = np.flatnonzero(which == model)
            root = np.sqrt(self.grid.theta[keep[model]])
            prior = (
                np.tensordot(root, self.base[:, rows], axes=1) + np.sqrt(self.grid.own[keep[model]]) * self.own[rows]
            )
            out[rows] = means[model] + prior
            if conditioning is not None:
                link, inverse = conditioning
                error = prior[:, at] + np.sqrt(noise) * self.errors[rows][:, : len(at)]
                out[rows] -= error @ inverse[model] @ link[model].T
        return out


def pooled(samples: Observations) -> tuple[np.ndarray, Floats, Floats]:
    """Complete samples, one a machine: index, mean log-latency, variance of its error.

    Repeats are weighed by their precision; repeats that contradict each other widen the error by the Birge ratio
    (Birge, Phys. Rev. 40 (1932) 207).
    """
    use = ~samples.lower_bound
    error = np.where(np.isnan(samples.relative_error), DEFAULT_NOISE, samples.relative_error)
    variance = error[use] ** 2 + SYSTEMATIC_NOISE**2
    log = np.log(samples.latency_s[use])
    machines = np.unique(samples.machine[use])
    value, spread = np.empty(len(machines)), np.empty(len(machines))
    for i, machine in enumerate(machines):
        mine = samples.machine[use] == machine
        precision = 1 / variance[mine]
        value[i] = (precision * log[mine]).sum() / precision.sum()
        chi2 = (precision * (log[mine] - value[i]) ** 2).sum()
        spread[i] = max(1.0, chi2 / max(1, mine.sum() - 1)) / precision.sum()
    return machines, value, spread


def _level(samples: Observations) -> float:
    return float(np.log(samples.latency_s).mean()) if len(samples.latency_s) else 0.0


def _bounds(samples: Observations) -> list[tuple[int, float]]:
    """The highest lower bound of each machine that has one."""
    highest: dict[int, float] = {}
    for machine, latency in zip(
        samples.machine[samples.lower_bound], samples.latency_s[samples.lower_bound], strict=True
    ):
        highest[int(machine)] = max(highest.get(int(machine), -np.inf), float(np.log(latency)))
    return sorted(highest.items())


def _site(posterior: Posterior, machine: int, bound: float) -> tuple[float, float] | None:
    """A Gaussian stand-in (value, variance) for "log-latency is above the bound", by moment matching."""
    mean, variance = float(posterior.mean[machine]), float(posterior.sd[machine] ** 2)
    after_mean, after_variance = truncated_above_moments(mean, variance, bound)
    precision = 1 / after_variance - 1 / variance
    if precision < 1e-9:
        return None
    return (after_mean / after_variance - mean / variance) / precision, 1 / precision


def _kept(evidence: Floats) -> tuple[np.ndarray, Floats]:
    """Models that stand for all, and their weights: systematic resampling along the grid's order.

    The most likely ones alone would not do: where samples say little, thousands of models are about equally likely,
    and what they disagree on is the uncertainty.
    """
    share = np.exp(evidence - evidence.max())
    at = np.cumsum(share / share.sum())
    picked = np.searchsorted(at, (np.arange(KEPT_MODELS) + 0.5) / KEPT_MODELS)
    keep, count = np.unique(np.minimum(picked, len(evidence) - 1), return_counts=True)
    return keep, count / KEPT_MODELS
