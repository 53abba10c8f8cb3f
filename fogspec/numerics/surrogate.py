"""Surrogate model: latency over machines from few samples, with calibrated uncertainty.

Interface::

    space = prepare(machines, prior)            # once per set of machines; prior is optional
    posterior = space.fit(observations)         # after every batch; fit(machines, observations, prior) does both
    posterior.mean, posterior.sd                # log-latency of every machine (N,), measured ones included
    posterior.quantile(0.95)                    # latency_s (N,)
    posterior.probability_below(limit_s)        # (N,), limit_s a number or (N,)
    posterior.measured, posterior.extrapolated  # masks (N,)
    posterior.draws                             # joint draws of log-latency (S, N)
    acquisition.next_wave(posterior, question, ...)

Model: log-latency = level + mean curve + Gaussian process, averaged over an ensemble of mean curves and hyper-parameters by
evidence (Rasmussen and Williams, Gaussian Processes for Machine Learning, ch. 2 and 5). Mean curves are Amdahl's law with
contention (Gunther's Universal Scalability Law) or, with a prior, the mean profile of other workloads on the same machines.
Equal inputs give equal numbers: random draws have a fixed seed. Tests hold evidence, posterior and quantiles to scipy.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from fogspec.numerics.calibration import Calibration, deviations
from fogspec.numerics.ensemble import Ensemble, ensemble_with_prior, ensemble_without_prior
from fogspec.numerics.kernels import Floats, Machines, distinct
from fogspec.numerics.normal import normal_cdf_and_density, normal_quantile, truncated_above_moments
from fogspec.numerics.observations import Observations, lower_bounds, mean_level, pooled
from fogspec.numerics.servers import Shifts, shifts_of

VERSION = 1  # of the model: predictions of another version may differ from the same samples
OUTLIER = 0.5  # deviation of log-latency from the other machines' prediction that noise does not explain
KEPT_MODELS = 64
MAX_EVIDENCE = 100  # samples in the evidence of the models; predictions use all samples
MAX_BLOCK = 4_000_000  # numbers in a table: with many samples of many machines, models are conditioned in blocks
DRAWS = 512
MOST_STEPS = 60  # of the search for a quantile; Newton's method takes about six
PRECISION = 1e-9  # of a quantile, in standard deviations
MAX_DRAWN = 600_000  # numbers in a table of draws: over thousands of machines there are fewer draws


@dataclass(frozen=True, slots=True)
class Prior:
    """Log-latency profiles (W, N) of W other workloads on the same N machines, without missing cells.

    `weight` (W,) is the weight of each workload (thirty variants of one program are not thirty workloads); `nugget` (N,) is
    the variance added for a machine whose cells were imputed from similar machines.
    """

    profiles: Floats
    weight: Floats
    nugget: Floats


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """Posterior of every machine's log-latency: a mixture of Gaussian processes, weights summing to 1.

    With `shifts` its quantiles and probabilities are those of another server of each type (`elsewhere`), and with `stretch`
    (N,) they are that much farther from the mean. `left_out` returns the deviations of `Calibration.of`.
    """

    machines: Machines
    observations: Observations
    weights: Floats
    means: Floats
    variances: Floats
    draw: Callable[[], Floats] = field(repr=False, compare=False)
    left_out: Callable[[], Floats] | None = field(default=None, repr=False, compare=False)
    shifts: Shifts | None = None
    stretch: Floats | None = None

    @cached_property
    def calibration(self) -> Calibration:
        """How many of the measured machines lie in the range that the others give them."""
        return Calibration.of(np.empty(0) if self.left_out is None else self.left_out())

    @cached_property
    def elsewhere(self) -> "Posterior":
        """The posterior with the quantiles and probabilities of another server of each type; means and draws stay."""
        return self.widened(self.calibration.factor)

    def widened(self, factor: float) -> "Posterior":
        """Return `elsewhere` with the ranges of predictions, and of samples of unknown spread, widened by this factor."""
        known = np.zeros(len(self.machines), dtype=bool)
        known[self.observations.machine[~np.isnan(self.observations.relative_error)]] = True
        stretch = np.where(self.measured & (known | (self.samples > 1)), 1.0, factor)
        return replace(self, shifts=shifts_of(self.machines.cloud), stretch=stretch)

    def take(self, rows: NDArray[np.intp]) -> "Posterior":
        """Return the posterior of the machines at these indices, without draws."""
        return replace(
            self,
            machines=self.machines.take(rows),
            means=self.means[:, rows],
            variances=self.variances[:, rows],
            shifts=None if self.shifts is None else self.shifts.take(rows),
            stretch=None if self.stretch is None else self.stretch[rows],
        )

    def _below(self, log_latency: Floats) -> tuple[Floats, Floats]:
        """Return the probability (N,) that each machine's log-latency is at most `log_latency` (N,), and the density."""
        if self.stretch is None:
            return self._below_unstretched(log_latency)
        below, density = self._below_unstretched(self.mean + (log_latency - self.mean) / self.stretch)
        return below, density / self.stretch

    def _below_unstretched(self, log_latency: Floats) -> tuple[Floats, Floats]:
        root = self._roots
        core, density = normal_cdf_and_density((log_latency - self.means) / root)
        below, density = self.weights @ core, self.weights @ (density / root)
        if self.shifts is None:
            return below, density
        # The wide part is wider than the models differ: their mean and variance are enough for it.
        sd, tail = np.sqrt(self.sd**2 + self.shifts.core + self.shifts.spread), self.shifts.tail
        wide, of_wide = normal_cdf_and_density((log_latency - self.mean) / sd)
        return (1 - tail) * below + tail * wide, (1 - tail) * density + tail * of_wide / sd

    @cached_property
    def _roots(self) -> Floats:
        """Standard deviations of log-latency under each model, on another server if so asked, (H, N)."""
        return np.sqrt(self.variances if self.shifts is None else self.variances + self.shifts.core)

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
        """Number of complete samples of each machine itself, (N,)."""
        return np.bincount(self.observations.machine[self.observations.own], minlength=len(self.machines))

    @cached_property
    def measured(self) -> np.ndarray:
        """Machines with at least one complete sample of their own (N,)."""
        return np.asarray(self.samples > 0)

    @cached_property
    def nested(self) -> np.ndarray:
        """Machines that were not measured themselves, but on a part of a larger one, (N,)."""
        seen = np.isin(np.arange(len(self.machines)), self.observations.machine[self.observations.nested])
        return np.asarray(seen & ~self.measured)

    @cached_property
    def extrapolated(self) -> np.ndarray:
        """Machines outside the sampled range of vCPUs or memory, or of a GPU type or architecture without a sample, (N,)."""
        m, known = self.machines, self.measured | self.nested
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
        """Return the probability (N,) that latency is at most the limit; 1 for an infinite limit, 0 for a limit <= 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = np.broadcast_to(np.log(np.maximum(limit_s, 0.0)), self.mean.shape)
            return self._below(limit)[0]

    @cached_property
    def _quantiles(self) -> dict[float, Floats]:
        """Cache of quantiles: other limits on the same samples need no bisection."""
        return {}

    def quantile(self, p: Floats | float) -> Floats:
        """Return the latency in seconds (N,) not exceeded with probability p, a number or (N,).

        Raise ValueError for a probability outside 0 to 1.
        """
        if not isinstance(p, float):
            return self._solved(p)
        if p not in self._quantiles:
            self._quantiles[p] = self._solved(p)
        return self._quantiles[p]

    def _solved(self, p: Floats | float) -> Floats:
        if not np.all((np.asarray(p) > 0) & (np.asarray(p) < 1)):
            raise ValueError(f"a probability lies between 0 and 1, got {p}")
        return np.asarray(np.exp(np.clip(self._root(np.broadcast_to(p, self.mean.shape)), -600, 600)))

    def _root(self, p: Floats) -> Floats:
        """Return the log-latency (N,) not exceeded with probability p (N,): Newton's method, kept within a bracket."""
        sd = self.sd if self.shifts is None else np.sqrt(self.sd**2 + self.shifts.core + self.shifts.spread)
        sd = sd if self.stretch is None else sd * self.stretch
        low, high, found = self.mean - 12 * sd, self.mean + 12 * sd, self.mean + sd * normal_quantile(p)
        active, part = np.arange(len(found)), self
        for _ in range(MOST_STEPS):
            at = found[active]
            below, density = part._below(at)
            off = below - p[active]
            low[active], high[active] = np.where(off < 0, at, low[active]), np.where(off < 0, high[active], at)
            with np.errstate(divide="ignore", invalid="ignore"):
                then = at - off / density
            inside = (then > low[active]) & (then < high[active])
            found[active] = np.where(inside, then, (low[active] + high[active]) / 2)
            far = np.abs(found[active] - at) > PRECISION * sd[active]
            if not far.any():
                break
            if not far.all():
                active, part = active[far], part.take(np.flatnonzero(far))
        return found


def prepare(machines: Machines, prior: Prior | None = None, *, seed: int = 0, draws: int = DRAWS) -> "Space":
    """Return the part of the model that does not depend on samples; the posterior will have at most `draws` draws."""
    ensemble = ensemble_without_prior(machines) if prior is None else ensemble_with_prior(machines, prior)
    return Space(machines, ensemble, seed, min(draws, max(MAX_DRAWN // max(len(machines), 1), 64)))


def fit(machines: Machines, samples: Observations, prior: Prior | None = None) -> Posterior:
    """Return the posterior of one workload's latency on every machine; see `Space.fit`."""
    return prepare(machines, prior).fit(samples)


@dataclass(frozen=True)
class Space:
    """Machines, the ensemble of models over them, and reusable random draws, made on first use."""

    machines: Machines
    ensemble: Ensemble
    seed: int
    count: int

    @cached_property
    def _normal(self) -> tuple[Floats, Floats, Floats]:
        """Standard normal draws of each component at each machine (J, S, N), of each machine alone, and of errors."""
        random = np.random.default_rng(self.seed)
        base = [random.standard_normal((self.count, f.shape[1])) @ f.T for f in self.ensemble.features]
        shape = (self.count, len(self.machines))
        return np.array(base), random.standard_normal(shape), random.standard_normal(shape)

    def fit(self, samples: Observations) -> Posterior:
        """Condition every model of the ensemble on the samples and weight it by its evidence.

        Outliers, such as machines that swap, keep their measured value but are down-weighted for other machines.
        """
        samples = samples.in_order()
        at, value, variance = pooled(samples)
        posterior = self._conditioned(samples, at, value, variance)
        off = value - posterior.mean[at]
        outlier = np.flatnonzero(np.abs(off) > OUTLIER)
        known = at[outlier], value[outlier], variance[outlier].copy()
        if len(outlier):
            variance[outlier] += off[outlier] ** 2
            posterior = self._conditioned(samples, at, value, variance)
        for machine, bound in lower_bounds(samples):
            site = _site(posterior, machine, bound)
            if site is not None:
                at, value, variance = np.append(at, machine), np.append(value, site[0]), np.append(variance, site[1])
                posterior = self._conditioned(samples, at, value, variance)
        posterior = self._as_measured(posterior, *known) if len(outlier) else posterior
        return replace(posterior, left_out=partial(self._left_out, samples, at, value, variance))

    def _left_out(self, samples: Observations, at: np.ndarray, value: Floats, noise: Floats) -> Floats:
        """Return the deviation of each measured machine from what the others say, over their 90% range: see `deviations`.

        Every model is conditioned on the other machines in closed form (Rasmussen and Williams, section 5.4.2).
        """
        few = _few(len(at))
        at, residual, noise = at[few], value[few] - mean_level(samples), noise[few]
        models, covariance = self._distinct(np.arange(len(self.ensemble.theta)))
        cross = np.array([f[at] @ f[at].T for f in self.ensemble.features])
        precision = np.linalg.inv(self._inner(models, cross, at, noise))
        residual = residual - self.ensemble.curves[:, at][self.ensemble.curve]
        variance = (1 / np.einsum("hii->hi", precision))[covariance]
        off = np.einsum("hij,hj->hi", precision[covariance], residual) * variance
        evidence = self._evidence(cross, at, value[few] - mean_level(samples), noise)
        log = evidence[:, None] + 0.5 * off**2 / variance + 0.5 * np.log(variance)
        weights = np.exp(log - log.max(0))
        real = np.isin(at, samples.machine[samples.own])
        return deviations(
            (weights / weights.sum(0))[:, real],
            off[:, real],
            (np.maximum(variance - noise, 1e-8) * self.ensemble.inflation)[:, real],
            shifts_of(self.machines.cloud).take(at[real]),
        )

    def _as_measured(self, posterior: Posterior, at: np.ndarray, value: Floats, variance: Floats) -> Posterior:
        """Return the posterior with the machines `at` (M,) at their measured values."""
        means, variances = posterior.means.copy(), posterior.variances.copy()
        means[:, at], variances[:, at] = value, variance

        def draw() -> Floats:
            drawn = posterior.draw()
            drawn[:, at] = value + np.sqrt(variance) * self._normal[1][:, at]
            return drawn

        return replace(posterior, means=means, variances=variances, draw=draw)

    def _conditioned(self, samples: Observations, at: np.ndarray, value: Floats, noise: Floats) -> Posterior:
        ensemble, level = self.ensemble, mean_level(samples)
        if not len(at):
            keep, weights = _resampled(np.zeros(len(ensemble.theta)))
            means = ensemble.curves[ensemble.curve[keep]] + level
            variances = ensemble.theta[keep] @ ensemble.diagonal + ensemble.nugget[keep]
            return Posterior(
                machines=self.machines,
                observations=samples,
                weights=weights,
                means=means,
                variances=variances,
                draw=partial(self._draws, keep=keep, weights=weights, means=means, at=at, noise=noise, terms=None),
            )
        cross = np.array([f @ f[at].T for f in ensemble.features])
        few = _few(len(at))
        keep, weights = _resampled(
            self._evidence(cross[:, at][:, few][:, :, few], at[few], value[few] - level, noise[few])
        )
        # Models differ in mean curve or covariance: what follows from the covariance is computed once for each.
        models, covariance = self._distinct(keep)
        means = ensemble.curves[ensemble.curve[keep]] + level
        residual = value - means[:, at]
        variances = np.empty((len(models), len(self.machines)))
        at_once = max(1, MAX_BLOCK // (len(at) * len(self.machines)))
        found = None
        for first in range(0, len(models), at_once):
            link, inverse = found = self._terms(models[first : first + at_once], cross, at, noise)
            variances[first : first + at_once] = -np.einsum("hni,hni->hn", link @ inverse, link)
            for i in range(len(link)):
                mine = covariance == first + i
                means[mine] += residual[mine] @ inverse[i] @ link[i].T
        variances += ensemble.theta[models] @ ensemble.diagonal + ensemble.nugget[models]
        variances = np.maximum(variances, 1e-8)
        variances[:, np.isin(np.arange(len(self.machines)), at, invert=True)] *= ensemble.inflation

        def terms(model: int) -> tuple[Floats, Floats]:
            one = int(covariance[model])
            if found is not None and len(found[0]) == len(models):
                return found[0][one], found[1][one]
            link, inverse = self._terms(models[one : one + 1], cross, at, noise)
            return link[0], inverse[0]

        return Posterior(
            machines=self.machines,
            observations=samples,
            weights=weights,
            means=means,
            variances=variances[covariance],
            draw=partial(self._draws, keep=keep, weights=weights, means=means, at=at, noise=noise, terms=terms),
        )

    def _distinct(self, models: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return one model for each covariance of these models, and the position of each model's among them."""
        rows = np.column_stack([self.ensemble.theta[models], self.ensemble.nugget[models, 0]])
        _, first, of = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        return models[first], of.ravel()

    def _inner(self, models: np.ndarray, cross: Floats, at: np.ndarray, noise: Floats) -> Floats:
        """Return the covariance of the samples under these models, (h, n, n); `cross` (J, n, n) is that of each component."""
        same_machine = (at[:, None] == at[None, :]).astype(float)
        inner = np.tensordot(self.ensemble.theta[models], cross, axes=1)
        inner += self.ensemble.nugget[np.ix_(models, at)][:, :, None] * same_machine + np.diag(noise)
        return np.asarray(inner)

    def _evidence(self, cross: Floats, at: np.ndarray, value: Floats, noise: Floats) -> Floats:
        """Return the log-evidence (H,) of every model up to a constant."""
        models, covariance = self._distinct(np.arange(len(self.ensemble.theta)))
        inner = self._inner(models, cross, at, noise)
        residual = value - self.ensemble.curves[:, at][self.ensemble.curve]
        solved = np.einsum("hij,hj->hi", np.linalg.inv(inner)[covariance], residual)
        return np.asarray(-0.5 * (residual * solved).sum(1) - 0.5 * np.linalg.slogdet(inner)[1][covariance])

    def _terms(self, models: np.ndarray, cross: Floats, at: np.ndarray, noise: Floats) -> tuple[Floats, Floats]:
        """Return the covariance of the machines with the samples (h, N, n) and the samples' precision (h, n, n)."""
        link = np.tensordot(self.ensemble.theta[models], cross, axes=1)
        link[:, at, np.arange(len(at))] += self.ensemble.nugget[np.ix_(models, at)]
        inverse = np.asarray(np.linalg.inv(self._inner(models, cross[:, at], at, noise)), dtype=float)
        return np.asarray(link), inverse

    def _draws(
        self,
        *,
        keep: np.ndarray,
        weights: Floats,
        means: Floats,
        at: np.ndarray,
        noise: Floats,
        terms: Callable[[int], tuple[Floats, Floats]] | None,
    ) -> Floats:
        """Return joint draws by Matheron's rule: a prior draw minus the prediction of its error at the samples."""
        count, (base, own, errors) = self.count, self._normal
        which = np.minimum(np.searchsorted(np.cumsum(weights), (np.arange(count) + 0.5) / count), len(weights) - 1)
        out = np.empty((count, len(self.machines)))
        for model in distinct(which).tolist():
            rows = slice(*np.searchsorted(which, [model, model + 1]))
            prior = np.sqrt(self.ensemble.nugget[keep[model]]) * own[rows]
            for amplitude, component in zip(np.sqrt(self.ensemble.theta[keep[model]]), base, strict=True):
                if amplitude:
                    prior += amplitude * component[rows]
            out[rows] = means[model] + prior
            if terms is not None:
                link, inverse = terms(model)
                error = prior[:, at] + np.sqrt(noise) * errors[rows][:, : len(at)]
                out[rows] -= error @ inverse @ link.T
        return out


def _few(count: int) -> np.ndarray:
    """Return the samples, of so many, that the evidence of the models is computed from."""
    return distinct(np.linspace(0, count - 1, min(count, MAX_EVIDENCE)).round().astype(int))


def _site(posterior: Posterior, machine: int, bound: float) -> tuple[float, float] | None:
    """Return the Gaussian site (value, variance) of "log-latency is above the bound" by moment matching, None if flat."""
    mean, variance = float(posterior.mean[machine]), float(posterior.sd[machine] ** 2)
    after_mean, after_variance = truncated_above_moments(mean, variance, bound)
    precision = 1 / after_variance - 1 / variance
    if precision < 1e-9:
        return None
    return (after_mean / after_variance - mean / variance) / precision, 1 / precision


def _resampled(evidence: Floats) -> tuple[np.ndarray, Floats]:
    """Return representative models and their weights by systematic resampling in the order of the ensemble.

    The most likely models alone are not enough: with few samples, thousands of models are about equally likely, and their
    disagreement is the uncertainty.
    """
    share = np.exp(evidence - evidence.max())
    at = np.cumsum(share / share.sum())
    picked = np.searchsorted(at, (np.arange(KEPT_MODELS) + 0.5) / KEPT_MODELS)
    keep, count = np.unique(np.minimum(picked, len(evidence) - 1), return_counts=True)
    return keep, count / KEPT_MODELS
