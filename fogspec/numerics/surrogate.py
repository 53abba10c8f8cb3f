"""Surrogate model: latency over machines from few samples, with calibrated uncertainty.

Interface::

    space = prepare(machines, prior)            # once per set of machines; prior is optional
    posterior = space.fit(observations)         # after every batch; fit(machines, observations, prior) does both
    posterior.mean, posterior.sd                # log-latency of every machine (N,), measured ones included
    posterior.prediction                        # the distribution on another server of each type: `Prediction`
    posterior.measured, posterior.extrapolated  # masks (N,)
    posterior.draws                             # joint draws of log-latency (S, N)

Model: log-latency = level + mean curve + Gaussian process, averaged over an ensemble of mean curves and hyper-parameters by
evidence (Rasmussen and Williams, Gaussian Processes for Machine Learning, ch. 2 and 5). Mean curves are Amdahl's law with
contention (Gunther's Universal Scalability Law) or, with a prior, the mean profile of other workloads on the same machines.
Equal inputs give equal numbers: random draws have a fixed seed. Tests hold evidence, posterior and quantiles to scipy.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from fogspec.numerics.ensemble import Ensemble, ensemble_with_prior, ensemble_without_prior
from fogspec.numerics.kernels import Floats, Machines, distinct, quantised
from fogspec.numerics.normal import truncated_above_moments
from fogspec.numerics.observations import Observations, lower_bounds, mean_level, pooled
from fogspec.numerics.prediction import Prediction
from fogspec.numerics.servers import shifts_of

VERSION = 2  # of the model: predictions of another version may differ from the same samples
LEAST_WEIGHT = 0.1  # of a suite that is named
LEVEL = 0.9  # of the range in which measured machines must lie, as far as the others say
FEWEST = 5  # machines left out
FACTORS = np.arange(10, 51) / 10  # beyond five the model is wrong, not its widths
MAX_EVIDENCE = 100  # samples in the evidence of the models; predictions use all samples
MAX_BLOCK = 4_000_000  # numbers in a table: with many samples of many machines, models are conditioned in blocks
DRAWS = 512
MAX_DRAWN = 600_000  # numbers in a table of draws: over thousands of machines there are fewer draws


@dataclass(frozen=True, slots=True)
class Prior:
    """Log-latency profiles (W, N) of W other workloads on the same N machines, without missing cells.

    `weight` (W,) is the weight of each workload (thirty variants of one program are not thirty workloads), and the weights sum
    to 1; `nugget` (N,) is the variance added for a machine whose cells were imputed from similar machines. `suites` (W,) are
    those that the workloads are of.
    """

    profiles: Floats
    weight: Floats
    nugget: Floats
    suites: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class LeftOut:
    """What the others say of each of the M machines `at` that were measured, and their mean log-latency as measured (M,)."""

    at: np.ndarray
    log_measured: Floats
    prediction: Prediction

    @cached_property
    def factor(self) -> float:
        """The least tenth by which sigma must be multiplied for as many to lie in their ranges as `LEVEL` says (ADR 0020).

        It is 1 where they do, and of fewer than `FEWEST`, which tell nothing of how often a range holds.
        """
        if len(self.at) < FEWEST:
            return 1.0
        covered = self.prediction.widened(FACTORS[:, None]).covers(self.log_measured, LEVEL).sum(1)
        enough = FACTORS[covered >= int(LEVEL * len(self.at) + 0.5)]
        return float(enough[0] if len(enough) else FACTORS[-1])


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """Posterior of every machine's log-latency: a mixture of Gaussian processes, weights summing to 1.

    Its mean and standard deviation are those of one normal, in `prediction` with what servers of a type differ by. `leave_out`
    returns what the other machines say of each, and `by_suite` the weights of the machine library's suites.
    """

    machines: Machines
    observations: Observations
    weights: Floats
    means: Floats
    variances: Floats
    draw: Callable[[], Floats] = field(repr=False, compare=False)
    leave_out: Callable[[], LeftOut] | None = field(default=None, repr=False, compare=False)
    by_suite: Callable[[], dict[str, float]] = field(default=dict, repr=False, compare=False)

    @cached_property
    def left_out(self) -> LeftOut | None:
        """What the other machines say of each measured one; None of nothing measured."""
        return None if self.leave_out is None or not self.measured.any() else self.leave_out()

    @cached_property
    def scales_like(self) -> dict[str, float]:
        """The suites of the machine library that predictions lean on, largest weight first, to two digits."""
        return {name: round(weight, 2) for name, weight in self.by_suite().items() if abs(weight) >= LEAST_WEIGHT}

    @cached_property
    def prediction(self) -> Prediction:
        """The distribution on another server of each type (N,); of machines that were not measured, as wide as they err."""
        found = Prediction(self.mean, self.sd, *shifts_of(self.machines.cloud))
        factor = 1.0 if self.left_out is None else self.left_out.factor
        return found.widened(np.where(self.measured, 1.0, factor))

    @cached_property
    def draws(self) -> Floats:
        """Joint draws of log-latency (S, N)."""
        return quantised(self.draw())

    @cached_property
    def mean(self) -> Floats:
        """Mean log-latency (N,)."""
        return quantised(self.weights @ self.means)

    @cached_property
    def sd(self) -> Floats:
        """Standard deviation of log-latency (N,)."""
        return quantised(np.sqrt(self.weights @ (self.variances + (self.means - self.mean) ** 2)))

    @cached_property
    def samples(self) -> np.ndarray:
        """Number of complete samples of each machine itself, (N,)."""
        return np.bincount(self.observations.machine[self.observations.own], minlength=len(self.machines))

    @cached_property
    def measured(self) -> np.ndarray:
        """Machines with at least one complete sample of their own (N,)."""
        return np.asarray(self.samples > 0)

    @cached_property
    def extrapolated(self) -> np.ndarray:
        """Machines outside the sampled range of vCPUs or memory, or of a GPU type or architecture without a sample, (N,)."""
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


def prepare(machines: Machines, prior: Prior | None = None, *, seed: int = 0, draws: int = DRAWS) -> "Space":
    """Return the part of the model that does not depend on samples; the posterior will have at most `draws` draws."""
    ensemble = ensemble_without_prior(machines) if prior is None else ensemble_with_prior(machines, prior)
    return Space(machines, ensemble, seed, min(draws, max(MAX_DRAWN // max(len(machines), 1), 64)), prior)


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
    prior: Prior | None = None

    @cached_property
    def _normal(self) -> tuple[Floats, Floats, Floats]:
        """Standard normal draws of each component at each machine (J, S, N), of each machine alone, and of errors."""
        random = np.random.default_rng(self.seed)
        base = [random.standard_normal((self.count, f.shape[1])) @ f.T for f in self.ensemble.features]
        shape = (self.count, len(self.machines))
        return np.array(base), random.standard_normal(shape), random.standard_normal(shape)

    def damped(self, share: float, at: int) -> "Space":
        """Return the space of a workload of which, on the machine `at`, only this share becomes faster or slower with size."""
        curves = self.ensemble.curves - self.ensemble.curves[:, [at]]
        curves = np.log1p(share * np.expm1(curves))
        return replace(self, ensemble=replace(self.ensemble, curves=curves - curves.mean(1, keepdims=True)))

    def fit(self, samples: Observations) -> Posterior:
        """Condition every model of the ensemble on the samples and weight it by its evidence."""
        samples = samples.in_order()
        at, value, variance = pooled(samples)
        posterior = self._conditioned(samples, at, value, variance)
        for machine, bound in lower_bounds(samples):
            site = _site(posterior, machine, bound)
            if site is not None:
                at, value, variance = np.append(at, machine), np.append(value, site[0]), np.append(variance, site[1])
                posterior = self._conditioned(samples, at, value, variance)
        return replace(
            posterior,
            leave_out=partial(self._left_out, samples, at, value, variance),
            by_suite=partial(self._by_suite, posterior.weights, at, value - mean_level(samples), variance),
        )

    def _by_suite(self, weights: Floats, at: np.ndarray, value: Floats, noise: Floats) -> dict[str, float]:
        """Return what the machine library adds to the predicted mean, as weights of its suites' profiles, largest first.

        They sum to 1 and may be negative; empty without a library. A program's weight is its prior one and what the samples
        show of its covariance component.
        """
        if self.prior is None:
            return {}
        models, covariance = self._distinct
        cross = np.array([f[at] @ f[at].T for f in self.ensemble.features])
        residual = value - self.ensemble.curves[:, at][self.ensemble.curve]
        solved = np.einsum("hij,hj->hi", np.linalg.inv(self._inner(models, cross, at, noise))[covariance], residual)
        root = np.sqrt(self.prior.weight)
        shown = root * ((weights * self.ensemble.theta[:, -1]) @ solved @ self.ensemble.features[-1][at])
        each = shown + self.prior.weight * (1 - shown.sum())
        total = {suite: float(sum(each[np.array(self.prior.suites) == suite])) for suite in set(self.prior.suites)}
        return dict(sorted(total.items(), key=lambda item: (-item[1], item[0])))

    def _left_out(self, samples: Observations, at: np.ndarray, value: Floats, noise: Floats) -> LeftOut:
        """Return each measured machine's log-latency from the others.

        Every model is conditioned on them in closed form (Rasmussen and Williams, section 5.4.2).
        """
        few = _few(len(at))
        at, value, noise, level = at[few], value[few], noise[few], mean_level(samples)
        models, covariance = self._distinct
        cross = np.array([f[at] @ f[at].T for f in self.ensemble.features])
        precision = np.linalg.inv(self._inner(models, cross, at, noise))
        residual = value - level - self.ensemble.curves[:, at][self.ensemble.curve]
        variance = (1 / np.einsum("hii->hi", precision))[covariance]
        off = np.einsum("hij,hj->hi", precision[covariance], residual) * variance
        evidence = self._evidence(cross, at, value - level, noise)
        log = evidence[:, None] + 0.5 * off**2 / variance + 0.5 * np.log(variance)
        weights = np.exp(log - log.max(0))
        weights /= weights.sum(0)
        mean = (weights * off).sum(0)
        own = np.maximum(variance - noise, 1e-8) * self.ensemble.inflation
        sd = np.sqrt((weights * (own + (off - mean) ** 2)).sum(0))
        real = np.isin(at, samples.machine[samples.own])
        prediction = Prediction(quantised(value - mean), quantised(sd), *shifts_of(self.machines.cloud[at]))
        return LeftOut(at[real], quantised(value[real]), prediction.take(np.flatnonzero(real)))

    def _conditioned(self, samples: Observations, at: np.ndarray, value: Floats, noise: Floats) -> Posterior:
        ensemble, level = self.ensemble, mean_level(samples)
        if not len(at):
            weights = np.full(len(ensemble.theta), 1 / len(ensemble.theta))
            means = ensemble.curves[ensemble.curve] + level
            variances = ensemble.theta @ ensemble.diagonal + ensemble.nugget
            return Posterior(
                machines=self.machines,
                observations=samples,
                weights=weights,
                means=means,
                variances=variances,
                draw=partial(self._draws, weights=weights, means=means, at=at, noise=noise, terms=None),
            )
        cross = np.array([f @ f[at].T for f in ensemble.features])
        few = _few(len(at))
        evidence = self._evidence(cross[:, at][:, few][:, :, few], at[few], value[few] - level, noise[few])
        weights = np.exp(evidence - evidence.max())
        weights /= weights.sum()
        # Models differ in mean curve or covariance: what follows from the covariance is computed once for each.
        models, covariance = self._distinct
        means = ensemble.curves[ensemble.curve] + level
        residual = value - means[:, at]
        variances = np.empty((len(models), len(self.machines)))
        at_once = max(1, MAX_BLOCK // (len(at) * len(self.machines)))
        found = None
        for first in range(0, len(models), at_once):
            half, root = found = self._terms(models[first : first + at_once], cross, at, noise)
            variances[first : first + at_once] = -np.einsum("hni,hni->hn", half, half)
            for i in range(len(half)):
                mine = covariance == first + i
                means[mine] += residual[mine] @ root[i].T @ half[i].T
        variances += ensemble.theta[models] @ ensemble.diagonal + ensemble.nugget[models]
        variances = np.maximum(variances, 1e-8)
        variances[:, np.isin(np.arange(len(self.machines)), at, invert=True)] *= self.ensemble.inflation

        def terms(model: int) -> tuple[Floats, Floats]:
            one = int(covariance[model])
            if found is not None and len(found[0]) == len(models):
                return found[0][one], found[1][one]
            half, root = self._terms(models[one : one + 1], cross, at, noise)
            return half[0], root[0]

        return Posterior(
            machines=self.machines,
            observations=samples,
            weights=weights,
            means=means,
            variances=variances[covariance],
            draw=partial(self._draws, weights=weights, means=means, at=at, noise=noise, terms=terms),
        )

    @cached_property
    def _distinct(self) -> tuple[np.ndarray, np.ndarray]:
        """One model for each covariance of the ensemble's, and the position of each model's among them."""
        rows = np.column_stack([self.ensemble.theta, self.ensemble.nugget[:, 0]])
        _, first, of = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        return first, of.ravel()

    def _inner(self, models: np.ndarray, cross: Floats, at: np.ndarray, noise: Floats) -> Floats:
        """Return the covariance of the samples under these models, (h, n, n); `cross` (J, n, n) is that of each component."""
        same_machine = (at[:, None] == at[None, :]).astype(float)
        inner = np.tensordot(self.ensemble.theta[models], cross, axes=1)
        inner += self.ensemble.nugget[np.ix_(models, at)][:, :, None] * same_machine + np.diag(noise)
        return np.asarray(inner)

    def _evidence(self, cross: Floats, at: np.ndarray, value: Floats, noise: Floats) -> Floats:
        """Return the log-evidence (H,) of every model up to a constant."""
        models, covariance = self._distinct
        inner = self._inner(models, cross, at, noise)
        residual = value - self.ensemble.curves[:, at][self.ensemble.curve]
        solved = np.einsum("hij,hj->hi", np.linalg.inv(inner)[covariance], residual)
        return np.asarray(-0.5 * (residual * solved).sum(1) - 0.5 * np.linalg.slogdet(inner)[1][covariance])

    def _terms(self, models: np.ndarray, cross: Floats, at: np.ndarray, noise: Floats) -> tuple[Floats, Floats]:
        """Return the covariance (h, N, n) of the machines with independent combinations of the samples, and these (h, n, n)."""
        # Their squares are the explained variances; the inverse of the samples' covariance would leave few digits of them.
        link = np.tensordot(self.ensemble.theta[models], cross, axes=1)
        link[:, at, np.arange(len(at))] += self.ensemble.nugget[np.ix_(models, at)]
        root = np.linalg.inv(np.linalg.cholesky(self._inner(models, cross[:, at], at, noise)))
        return np.asarray(link @ root.transpose(0, 2, 1)), np.asarray(root)

    def _draws(
        self,
        *,
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
            prior = np.sqrt(self.ensemble.nugget[model]) * own[rows]
            for amplitude, component in zip(np.sqrt(self.ensemble.theta[model]), base, strict=True):
                if amplitude:
                    prior += amplitude * component[rows]
            out[rows] = means[model] + prior
            if terms is not None:
                half, root = terms(model)
                error = prior[:, at] + np.sqrt(noise) * errors[rows][:, : len(at)]
                out[rows] -= error @ root.T @ half.T
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
