"""The fast numerics against scipy's answers: normal distribution, kernel, Gaussian process, families, relaxation."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import (
    LinearConstraint,
    NonlinearConstraint,
    differential_evolution,
    least_squares,
    lsq_linear,
)
from scipy.special import gamma, kv, ndtr
from scipy.stats import multivariate_normal, norm, truncnorm

from fogspec.numerics import families, relaxation
from fogspec.numerics.ensemble import Ensemble, ensemble_without_prior
from fogspec.numerics.families import Shape, fit_all
from fogspec.numerics.kernels import DIGITS, matern
from fogspec.numerics.normal import normal_cdf, truncated_above_moments
from fogspec.numerics.observations import DEFAULT_NOISE, SYSTEMATIC_NOISE, mean_level, observations
from fogspec.numerics.surrogate import Space, prepare
from tests.support.machines import family

MACHINES = family()
SPACE = prepare(MACHINES, draws=64)
ENSEMBLE = ensemble_without_prior(MACHINES)
NOISE = DEFAULT_NOISE**2 + SYSTEMATIC_NOISE**2
CPUS = np.repeat([2.0, 16.0, 64.0], 3)
MEMORY = CPUS * np.tile([2.0, 4.0, 8.0], 3)
CURVED = [
    Shape(cpu, memory)
    for cpu, memory in itertools.product(families.CPU_FAMILIES, families.MEMORY_FAMILIES)
    if {cpu, memory} & families.NONLINEAR and {cpu, memory} - families.NONLINEAR
]
STRAIGHT = [
    Shape(cpu, memory)
    for cpu, memory in itertools.product(families.CPU_FAMILIES, families.MEMORY_FAMILIES)
    if not {cpu, memory} & families.NONLINEAR
]

# Latencies on the paper's grid: scale, serial fraction, cost of each further core, effect of memory, noise.
latencies = st.builds(
    lambda scale, serial, further, memory, noise: (
        scale * ((1 - serial) / CPUS + serial + further * CPUS + memory / MEMORY) * np.exp(0.2 * np.array(noise))
    ),
    st.floats(1e-3, 1e2), st.floats(0, 1), st.floats(0, 0.03), st.floats(0, 2),
    st.lists(st.floats(-1, 1), min_size=9, max_size=9),
)  # fmt: skip
machines = st.integers(0, len(MACHINES) - 1)
sampled = st.lists(st.tuples(machines, st.floats(0.5, 2)), min_size=2, max_size=8, unique_by=lambda sample: sample[0])


@given(st.floats(-40, 40))
def test_normal_cdf_is_ndtr(z):
    assert normal_cdf(np.array([z]))[0] == pytest.approx(ndtr(z), abs=1e-7)


@given(st.floats(-5, 5), st.floats(0.01, 3), st.floats(-10, 60))
def test_moments_above_a_bound_are_those_of_truncnorm(mean, sd, z):
    found_mean, found_variance = truncated_above_moments(mean, sd**2, mean + z * sd)
    expected_mean, expected_variance = truncnorm.stats(z, np.inf, moments="mv")
    assert (found_mean - mean) / sd == pytest.approx(expected_mean, rel=1e-6, abs=1e-9)
    assert found_variance / sd**2 == pytest.approx(expected_variance, rel=1e-4)


@given(st.lists(st.tuples(st.floats(0, 8), st.floats(0, 4)), min_size=2, max_size=12), st.floats(0.5, 3))
def test_the_matern_root_squares_to_the_bessel_form(rows, length):
    columns = np.round(np.array(rows), 3)
    root = matern(columns, np.array([length, length]))
    distance = np.sqrt(5) * np.linalg.norm(columns[:, None] - columns[None], axis=-1) / length
    near = np.maximum(distance, 1e-6)
    expected = 2 ** (1 - 2.5) / gamma(2.5) * near**2.5 * kv(2.5, near)
    assert np.allclose(root @ root.T, expected, atol=1e-5)


def model_of(one: int) -> tuple[Ensemble, np.ndarray, np.ndarray]:
    """An ensemble of one model, its mean curve and its covariance over the machines."""
    alone = Ensemble(
        features=ENSEMBLE.features,
        curves=ENSEMBLE.curves[ENSEMBLE.curve[[one]]],
        curve=np.array([0]),
        theta=ENSEMBLE.theta[[one]],
        nugget=ENSEMBLE.nugget[[one]],
    )
    covariance = sum(t * f @ f.T for t, f in zip(ENSEMBLE.theta[one], ENSEMBLE.features, strict=True))
    return alone, alone.curves[0], covariance + np.diag(ENSEMBLE.nugget[one])


@given(sampled, st.integers(0, len(ENSEMBLE.theta) - 1))
def test_the_posterior_of_one_model_is_a_cholesky_solve(rows, one):
    alone, curve, covariance = model_of(one)
    at, latency = zip(*sorted(rows), strict=True)
    samples, at = observations(list(at), list(latency)), list(at)
    level = mean_level(samples)
    factor = cho_factor(covariance[np.ix_(at, at)] + NOISE * np.eye(len(at)))
    mean = curve + level + covariance[:, at] @ cho_solve(factor, np.log(latency) - level - curve[at])
    variance = np.diag(covariance - covariance[:, at] @ cho_solve(factor, covariance[at]))
    found = Space(MACHINES, alone, 0, 64).fit(samples)
    assert np.allclose(found.mean, mean, atol=1e-8)
    assert np.allclose(found.sd, np.sqrt(np.maximum(variance, 1e-8)), atol=1e-6)


@given(sampled, st.lists(st.integers(0, len(ENSEMBLE.theta) - 1), min_size=2, max_size=5, unique=True))
def test_models_are_weighted_by_the_multivariate_normal_density(rows, some):
    some = sorted(some)
    at, latency = zip(*sorted(rows), strict=True)
    samples, at = observations(list(at), list(latency)), list(at)
    value = np.log(latency) - mean_level(samples)
    log = []
    for one in some:
        _, curve, covariance = model_of(one)
        log.append(multivariate_normal.logpdf(value, curve[at], covariance[np.ix_(at, at)] + NOISE * np.eye(len(at))))
    expected = np.exp(log - max(log)) / np.exp(log - max(log)).sum()
    several = Ensemble(
        features=ENSEMBLE.features,
        curves=ENSEMBLE.curves[ENSEMBLE.curve[some]],
        curve=np.arange(len(some)),
        theta=ENSEMBLE.theta[some],
        nugget=ENSEMBLE.nugget[some],
    )
    posterior = Space(MACHINES, several, 0, 64).fit(samples)
    assert np.allclose(posterior.weights, expected, atol=1e-7)


@given(sampled, st.floats(0.01, 0.99), machines)
def test_quantiles_are_those_of_a_normal_log_latency(rows, p, machine):
    at, latency = zip(*rows, strict=True)
    posterior = SPACE.fit(observations(list(at), list(latency)))
    sigma = posterior.prediction.sigma[machine]
    expected = norm.ppf(p, posterior.mean[machine], sigma)
    slope = norm.pdf(norm.ppf(p)) / sigma
    assert np.log(posterior.prediction.on_measured_server.quantile(p)[machine]) == pytest.approx(
        expected, abs=2e-7 / slope + 1e-8
    )


@settings(max_examples=30)
@given(latencies, st.sampled_from(STRAIGHT))
def test_straight_families_are_lsq_linear(latency_s, shape):
    fit = next(fit for fit in fit_all(CPUS, MEMORY, latency_s) if fit.shape == shape)
    design = families.columns(shape, CPUS, MEMORY, ())
    scale = np.linalg.norm(design, axis=0)
    expected = lsq_linear(design / scale, latency_s, method="bvls", tol=1e-14).x / scale
    # Coefficients have nine significant digits, and their terms may cancel.
    rounded = 10.0 ** (1 - DIGITS) * np.abs(design) @ np.abs(expected)
    atol = rounded + 1e-9 * np.abs(latency_s).max()
    assert np.allclose(fit.predict(CPUS, MEMORY), design @ expected, rtol=1e-7, atol=atol)
    left_out = lsq_linear(design[1:] / scale, latency_s[1:], method="bvls", tol=1e-14).x / scale
    assert fit.loo[0] == pytest.approx(design[0] @ left_out / latency_s[0] - 1, rel=1e-5, abs=1e-7)


@settings(max_examples=15)
@given(latencies, st.sampled_from(CURVED))
def test_no_start_of_least_squares_finds_a_better_curve(latency_s, shape):
    """Held to 0.1% of the variance: the narrowed grid stays in the basin that its first round finds."""
    fit = next((fit for fit in fit_all(CPUS, MEMORY, latency_s) if fit.shape == shape), None)
    assert fit is not None
    axis = 0 if shape.nonlinear[0] else 1
    grid = families.exponent_grid((shape.cpu, shape.memory)[axis], (CPUS, MEMORY)[axis], families.GRID)

    def linear(exponent):
        design = families.columns(shape, CPUS, MEMORY, exponent)
        scale = np.linalg.norm(design, axis=0)
        return design @ (np.linalg.lstsq(design / scale, latency_s, rcond=1e-12)[0] / scale)

    total = np.sum((latency_s - latency_s.mean()) ** 2)
    found = [
        least_squares(lambda k: (linear(k) - latency_s) / np.sqrt(total), start, bounds=(grid.min(), grid.max()),
                      x_scale=abs(start), xtol=1e-12, ftol=1e-12, gtol=1e-12)
        for start in grid[1:-1:4]
    ]  # fmt: skip
    assert fit.r2 >= 1 - min(2 * one.cost for one in found) - 1e-3


box = relaxation.box_of(CPUS, MEMORY)
curves = st.tuples(st.floats(0.01, 2), st.floats(0.1, 20), st.floats(0, 0.05), st.floats(0, 4))


@settings(max_examples=12)
@given(curves, st.floats(0, 1), st.floats(0.05, 1), st.floats(0.05, 1))
def test_the_relaxed_optimum_is_that_of_a_global_search(curve, alpha, latency_level, cost_level):
    a, b, d, e = curve

    def latency(c, m):
        return a + b / c + d * c + e / m

    def cost(c, m):
        return (0.03 * c + 0.005 * m) * latency(c, m)

    scale = latency(CPUS, MEMORY).min(), cost(CPUS, MEMORY).min()
    limit = np.quantile(latency(CPUS, MEMORY), latency_level), np.quantile(cost(CPUS, MEMORY), cost_level)

    def objective(c, m):
        return alpha * latency(c, m) / scale[0] + (1 - alpha) * cost(c, m) / scale[1]

    def slack(c, m):
        return np.stack([1 - latency(c, m) / limit[0], 1 - cost(c, m) / limit[1]])

    quick = relaxation.minimise(objective, slack, box, refine=False)
    found = relaxation.minimise(objective, slack, box)
    low, high = np.log2([box.vcpus, box.memory_per_vcpu]).T
    expected = differential_evolution(
        lambda z: objective(2 ** z[0], 2 ** z.sum(axis=0)), list(zip(low, high, strict=True)), rng=0, popsize=8, tol=1e-8,
        polish=False, vectorized=True, updating="deferred",
        constraints=(
            NonlinearConstraint(lambda z: slack(2 ** z[0], 2 ** z.sum(axis=0)), 0, np.inf),
            LinearConstraint(np.ones((1, 2)), *np.log2(box.memory_gib)),
        ),
    )  # fmt: skip
    if found is None:
        assert expected.maxcv > 0
        return
    assert (slack(found.vcpus, found.memory_gib) >= -1e-12).all()
    assert box.memory_gib[0] * (1 - 1e-9) <= found.memory_gib <= box.memory_gib[1] * (1 + 1e-9)
    assert expected.maxcv > 0 or found.value <= expected.fun * (1 + 1e-6)
    if quick is not None:
        assert found.value <= quick.value <= found.value * (1 + 1e-3)
        at = CPUS, MEMORY
        assert relaxation.neighbours(quick, *at)[0] == relaxation.neighbours(found, *at)[0]
