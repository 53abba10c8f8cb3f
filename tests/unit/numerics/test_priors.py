"""What other workloads say of machines: kept apart, borrowed, completed."""

import numpy as np
import pytest

from fogspec.numerics.observations import mean_level, observations, pooled
from fogspec.numerics.priors import PriorData, prior_for
from fogspec.numerics.surrogate import fit, prepare
from tests.support.machines import amdahl, family

MACHINES = family()
NAMES = tuple(f"aws/{i}" for i in range(len(MACHINES)))
SERIAL = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)


def library(missing=(), suites=None):
    log = np.log(np.array([amdahl(MACHINES, serial) for serial in SERIAL]))
    for workload, machine in missing:
        log[workload, machine] = np.nan
    names = tuple(f"w{i}" for i in range(len(SERIAL)))
    return PriorData(names=NAMES, machines=MACHINES, workloads=names, suites=suites or names, log_latency=log)


def test_a_library_sharpens_predictions():
    truth, at = amdahl(MACHINES, 0.07), [0, 14]
    prior = prior_for(library(), NAMES, MACHINES)
    with_prior = fit(MACHINES, observations(at, truth[at]), prior)
    without = fit(MACHINES, observations(at, truth[at]))
    assert _error(with_prior, truth) < 0.5 * _error(without, truth)


def test_the_weights_of_suites_are_what_the_library_adds_to_the_prediction():
    """By conditioning each model on the samples (Rasmussen and Williams, eq. 2.38), for the library's component alone."""
    prior, at = prior_for(library(), NAMES, MACHINES), [0, 5, 14]
    samples = observations(at, amdahl(MACHINES, 0.07)[at])
    space = prepare(MACHINES, prior)
    posterior, ensemble = space.fit(samples), space.ensemble
    _, value, noise = pooled(samples)
    expected, own = np.zeros(len(MACHINES)), ensemble.features[-1]
    for weight, theta, alone, curve in zip(
        posterior.weights, ensemble.theta, ensemble.nugget, ensemble.curves[ensemble.curve], strict=True
    ):
        covariance = sum(one * f[at] @ f[at].T for one, f in zip(theta, ensemble.features, strict=True))
        covariance = covariance + np.diag(alone[at] + noise)
        off = np.linalg.solve(covariance, value - mean_level(samples) - curve[at])
        expected += weight * (curve + theta[-1] * own @ own[at].T @ off)
    weights = posterior.by_suite()
    found = sum(weights[f"w{i}"] * profile for i, profile in enumerate(prior.profiles))
    assert found == pytest.approx(expected, abs=1e-8)
    assert sum(weights.values()) == pytest.approx(1)


def test_a_program_scales_like_the_suite_that_it_could_be_of():
    truth, at = amdahl(MACHINES, 0.0), [0, 5, 6, 14]
    suites = ("alike", "alike", "b", "c", "d", "e")
    weights = fit(MACHINES, observations(at, truth[at]), prior_for(library(suites=suites), NAMES, MACHINES)).by_suite()
    assert next(iter(weights)) == "alike"
    assert weights["alike"] > 0.5
    assert fit(MACHINES, observations(at, truth[at])).by_suite() == {}


def test_a_machine_known_by_workloads_alone_that_do_not_count_is_imputed():
    n = len(NAMES)
    rare = [(0, machine) for machine in range(n - n // 4)]  # workload 0 is known on a quarter of the machines
    only = [(workload, n - 1) for workload in range(1, len(SERIAL))]  # and the last one by it alone
    prior = prior_for(library([*rare, *only]), NAMES, MACHINES)
    assert prior is not None
    assert len(prior.profiles) == len(SERIAL) - 1
    assert np.isfinite(prior.profiles).all()
    assert prior.nugget[-1] > 0


def test_a_suite_that_is_left_out_says_nothing():
    suites = ("a", "a", "b", "b", "b", "b")
    prior = prior_for(library(suites=suites), NAMES, MACHINES, leave_out=["a"])
    assert prior is not None
    assert len(prior.profiles) == 4
    assert prior_for(library(suites=suites), NAMES, MACHINES, leave_out=["b"]) is None
    assert prior_for(library(suites=suites), NAMES, MACHINES, leave_out=["a", "b"]) is None


def test_missing_cells_are_filled_close_to_what_they_were():
    whole = prior_for(library(), NAMES, MACHINES)
    holed = prior_for(library(missing=[(1, 4), (3, 9)]), NAMES, MACHINES)
    assert np.isfinite(holed.profiles).all()
    assert np.abs(holed.profiles - whole.profiles).max() < 0.2


def test_an_unknown_machine_borrows_from_its_kin_and_says_so():
    renamed = (*NAMES[:-1], "aws/new")
    prior = prior_for(library(), renamed, MACHINES)
    assert prior.nugget[-1] > 0
    assert (prior.nugget[:-1] == 0).all()
    assert np.abs(prior.profiles[:, -1] - prior_for(library(), NAMES, MACHINES).profiles[:, -1]).max() < 0.2


def test_a_table_of_the_wrong_shape_is_refused():
    with pytest.raises(ValueError, match="workloads x machines"):
        PriorData(
            names=NAMES, machines=MACHINES, workloads=("w",), suites=("s",), log_latency=np.zeros((2, len(NAMES)))
        )


def _error(posterior, truth):
    return float(np.abs(posterior.mean - np.log(truth)).mean())
