"""Latency over machines from few samples, with honest uncertainty.

The small, stable interface that everything else calls::

    space = prepare(machines, prior)            # once for a set of machines; prior is optional
    posterior = space.fit(observations)         # after every wave; fit(machines, observations, prior) does both
    posterior.mean, posterior.sd                # log-latency of every machine (N,), measured ones included
    posterior.quantile(0.95)                    # latency_s (N,)
    posterior.probability_below(limit_s)        # (N,), limit_s a number or (N,)
    posterior.measured, posterior.extrapolated  # masks (N,)
    posterior.draws                             # joint draws of log-latency (S, N)
    acquisition.next_wave(posterior, question, ...)

Model: log-latency = level + mean curve + Gaussian process, averaged over a grid of mean curves and
hyper-parameters by their evidence instead of picking one (Rasmussen and Williams, Gaussian Processes for Machine
Learning, ch. 2 and 5). Mean curves are Amdahl's law with contention (Gunther's Universal Scalability Law), and,
with a prior, what other workloads do on the same machines. Same inputs give the same numbers: the draws' random
numbers come from a fixed seed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from fogspec.numerics.ensemble import Grid, grid_with_prior, grid_without_prior
from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.normal import normal_cdf, truncated_above_moments
from fogspec.numerics.observations import Observations, level_of, lower_bounds, pooled

VERSION = 1  # of the model: predictions of another version may differ from the same samples
STRANGE = 0.5  # log-latency: no noise makes a machine so much faster or slower than the others have it
KEPT_MODELS = 64
WEIGHED_BY = 100  # samples that decide between models; all of them predict
MOST_AT_ONCE = 4_000_000  # numbers in a table: with many samples of many machines, models are conditioned in turn
DRAWS = 512
MOST_DRAWN = 600_000  # numbers in a table of draws: over thousands of machines there are fewer draws


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
    draw: Callable[[], Floats] = field(repr=False, compare=False)

    @cached_property
    def draws(self) -> Floats:
        """Joint draws of log-latency (S, N)."""
        return self.draw()

    @cached_property
    def mean(self) -> Floats:
        """Mean log-latency (N,)."""
        return np.asarray(self.weights @ self.means)

    @cached_property
    def sd(self) -> Floats:
        """Standard deviation of log-latency (N,)."""
        return np.asarray(np.sqrt(self.weights @ (self.variances + (self.means - self.mean) ** 2)))

    @cached_property
    def samples(self) -> np.ndarray:
        """How often each machine was measured (N,), complete samples only."""
        complete = self.observations.machine[~self.observations.lower_bound]
        return np.bincount(complete, minlength=len(self.machines))

    @cached_property
    def measured(self) -> np.ndarray:
        """Machines with at least one complete sample (N,)."""
        return np.asarray(self.samples > 0)

    @cached_property
    def extrapolated(self) -> np.ndarray:
        """Machines outside the sampled range of vCPUs or memory, or of a GPU type or architecture not sampled."""
        m, known = self.machines, self.measured
        if not known.any():
            return np.ones(len(m), dtype=bool)
        outside = np.zeros(len(m), dtype=bool)
        for column in (m.vcpus, m.memory_gib):
            outside |= (column < column[known].min()) | (column > column[known].max())
        outside |= ~np.isin(m.gpu, m.gpu[known])
        if (m.arch[known] >= 0).all():
            outside |= ~np.isin(m.arch, m.arch[known])
        return np.asarray(outside & ~known)

    def probability_below(self, limit_s: Floats | float) -> Floats:
        """Probability (N,) that latency is at most the limit; a limit of infinity gives 1, of 0 or less gives 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = np.broadcast_to(np.log(np.maximum(limit_s, 0.0)), self.mean.shape)
        return np.asarray(self.weights @ normal_cdf((limit - self.means) / np.sqrt(self.variances)))

    @cached_property
    def _quantiles(self) -> dict[float, Floats]:
        """What was asked for already: other limits on the same samples cost no bisection."""
        return {}

    def quantile(self, p: Floats | float) -> Floats:
        """Latency in seconds (N,) that is not exceeded with probability p, a number or (N,)."""
        if not isinstance(p, float):
            return self._bisected(p)
        if p not in self._quantiles:
            self._quantiles[p] = self._bisected(p)
        return self._quantiles[p]

    def _bisected(self, p: Floats | float) -> Floats:
        if not np.all((np.asarray(p) > 0) & (np.asarray(p) < 1)):
            raise ValueError(f"a probability lies between 0 and 1, got {p}")
        low, high = self.mean - 12 * self.sd, self.mean + 12 * self.sd
        root = np.sqrt(self.variances)
        for _ in range(24):
            middle = (low + high) / 2
            below = self.weights @ normal_cdf((middle - self.means) / root) < p
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(np.exp(np.clip((low + high) / 2, -600, 600)))


def prepare(machines: Machines, prior: Prior | None = None, *, seed: int = 0, draws: int = DRAWS) -> "Space":
    """Everything about the machines that does not depend on samples; `draws` joint draws will be made."""
    grid = grid_without_prior(machines) if prior is None else grid_with_prior(machines, prior)
    return Space(machines, grid, seed, min(draws, max(MOST_DRAWN // max(len(machines), 1), 64)))


def fit(machines: Machines, samples: Observations, prior: Prior | None = None) -> Posterior:
    """Posterior of one workload's latency on every machine; see `Space.fit`."""
    return prepare(machines, prior).fit(samples)


@dataclass(frozen=True)
class Space:
    """Machines, the grid of models over them, and reusable random draws, made when they are first needed."""

    machines: Machines
    grid: Grid
    seed: int
    count: int

    @cached_property
    def _normal(self) -> tuple[Floats, Floats, Floats]:
        """Standard normal draws of each component at each machine (J, S, N), of each machine alone, and of errors."""
        random = np.random.default_rng(self.seed)
        base = [random.standard_normal((self.count, f.shape[1])) @ f.T for f in self.grid.features]
        shape = (self.count, len(self.machines))
        return np.array(base), random.standard_normal(shape), random.standard_normal(shape)

    def fit(self, samples: Observations) -> Posterior:
        """Condition every model of the grid on the samples and weigh it by its evidence.

        A machine far off from what all others say of it, such as one that swaps, is as it was measured, and says
        little of others.
        """
        at, value, variance = pooled(samples)
        posterior = self._conditioned(samples, at, value, variance)
        off = value - posterior.mean[at]
        strange = np.flatnonzero(np.abs(off) > STRANGE)
        known = at[strange], value[strange], variance[strange].copy()
        if len(strange):
            variance[strange] += off[strange] ** 2
            posterior = self._conditioned(samples, at, value, variance)
        for machine, bound in lower_bounds(samples):
            site = _site(posterior, machine, bound)
            if site is not None:
                at, value, variance = np.append(at, machine), np.append(value, site[0]), np.append(variance, site[1])
                posterior = self._conditioned(samples, at, value, variance)
        return self._as_measured(posterior, *known) if len(strange) else posterior

    def _as_measured(self, posterior: Posterior, at: np.ndarray, value: Floats, variance: Floats) -> Posterior:
        """The posterior with some machines as they were measured, whatever the others say of them."""
        means, variances = posterior.means.copy(), posterior.variances.copy()
        means[:, at], variances[:, at] = value, variance

        def draw() -> Floats:
            drawn = posterior.draw()
            drawn[:, at] = value + np.sqrt(variance) * self._normal[1][:, at]
            return drawn

        return replace(posterior, means=means, variances=variances, draw=draw)

    def _conditioned(self, samples: Observations, at: np.ndarray, value: Floats, noise: Floats) -> Posterior:
        grid, level = self.grid, level_of(samples)
        if not len(at):
            keep, weights = _kept(np.zeros(len(grid.theta)))
            means = grid.curves[grid.curve[keep]] + level
            variances = grid.theta[keep] @ grid.diagonal + grid.own[keep]
            draw = partial(self._draws, keep, weights, means, at, noise, None)
            return Posterior(self.machines, samples, weights, means, variances, draw)
        cross = np.array([f @ f[at].T for f in grid.features])
        few = (
            np.unique(np.linspace(0, len(at) - 1, WEIGHED_BY).round().astype(int))
            if len(at) > WEIGHED_BY
            else slice(None)
        )
        keep, weights = _kept(self._evidence(cross[:, at][:, few][:, :, few], at[few], value[few] - level, noise[few]))
        means, variances = np.empty((2, len(keep), len(self.machines)))
        at_once = max(1, MOST_AT_ONCE // (len(at) * len(self.machines)))
        found = None
        for first in range(0, len(keep), at_once):
            some = keep[first : first + at_once]
            link, inverse = found = self._terms(some, cross, at, noise)
            mean = grid.curves[grid.curve[some]]
            solved = np.einsum("hij,hj->hi", inverse, value - level - mean[:, at])
            means[first : first + at_once] = mean + level + np.einsum("hni,hi->hn", link, solved)
            explained = ((link @ inverse) * link).sum(-1)
            variances[first : first + at_once] = grid.theta[some] @ grid.diagonal + grid.own[some] - explained
        variances = np.maximum(variances, 1e-8)
        variances[:, np.isin(np.arange(len(self.machines)), at, invert=True)] *= grid.widened

        def terms(model: int) -> tuple[Floats, Floats]:
            if found is not None and len(found[0]) == len(keep):
                return found[0][model], found[1][model]
            link, inverse = self._terms(keep[model : model + 1], cross, at, noise)
            return link[0], inverse[0]

        draw = partial(self._draws, keep, weights, means, at, noise, terms)
        return Posterior(self.machines, samples, weights, means, variances, draw)

    def _inner(self, models: np.ndarray, cross: Floats, at: np.ndarray, noise: Floats) -> Floats:
        """Covariance of the samples under these models (h, n, n); `cross` is each component's among them."""
        same_machine = (at[:, None] == at[None, :]).astype(float)
        inner = np.tensordot(self.grid.theta[models], cross, axes=1)
        inner += self.grid.own[models][:, at][:, :, None] * same_machine + np.diag(noise)
        return np.asarray(inner)

    def _evidence(self, cross: Floats, at: np.ndarray, value: Floats, noise: Floats) -> Floats:
        """Log-evidence (H,) of every model of the grid."""
        inner = self._inner(np.arange(len(self.grid.theta)), cross, at, noise)
        residual = value - self.grid.curves[self.grid.curve][:, at]
        solved = np.einsum("hij,hj->hi", np.linalg.inv(inner), residual)
        return np.asarray(-0.5 * (residual * solved).sum(1) - 0.5 * np.linalg.slogdet(inner)[1])

    def _terms(self, models: np.ndarray, cross: Floats, at: np.ndarray, noise: Floats) -> tuple[Floats, Floats]:
        """Covariance of every machine with the samples (h, N, n), and the inverse of that of the samples (h, n, n)."""
        link = np.tensordot(self.grid.theta[models], cross, axes=1)
        link += self.grid.own[models][:, :, None] * (np.arange(len(self.machines))[:, None] == at[None, :])
        inverse = np.asarray(np.linalg.inv(self._inner(models, cross[:, at], at, noise)), dtype=float)
        return np.asarray(link), inverse

    def _draws(
        self, keep: np.ndarray, weights: Floats, means: Floats, at: np.ndarray, noise: Floats,
        terms: Callable[[int], tuple[Floats, Floats]] | None,
    ) -> Floats:  # fmt: skip
        """Joint draws by Matheron's rule: a prior draw plus what its own error at the samples corrects."""
        count, (base, own, errors) = self.count, self._normal
        which = np.minimum(np.searchsorted(np.cumsum(weights), (np.arange(count) + 0.5) / count), len(weights) - 1)
        out = np.empty((count, len(self.machines)))
        for model in np.unique(which).tolist():
            rows = np.flatnonzero(which == model)
            root = np.sqrt(self.grid.theta[keep[model]])
            prior = np.tensordot(root, base[:, rows], axes=1) + np.sqrt(self.grid.own[keep[model]]) * own[rows]
            out[rows] = means[model] + prior
            if terms is not None:
                link, inverse = terms(model)
                error = prior[:, at] + np.sqrt(noise) * errors[rows][:, : len(at)]
                out[rows] -= error @ inverse @ link.T
        return out


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
