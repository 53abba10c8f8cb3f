"""What the surrogate says of machines after few samples, and after samples that are odd."""

import numpy as np
import pytest

from fogspec.choice.rule import independent
from fogspec.numerics import kernels
from fogspec.numerics.observations import observations
from fogspec.numerics.surrogate import FACTORS, Posterior, fit, prepare
from tests.support.machines import amdahl, family
from tests.support.relative import work_of

FEW = [0, 3, 6, 10, 17]


def test_recovers_a_scaling_law_from_five_noise_free_samples():
    machines = family()
    truth = amdahl(machines, 0.1)
    posterior = fit(machines, observations(FEW, truth[FEW], [0.0] * 5))
    assert np.abs(np.exp(posterior.mean) / truth - 1).max() < 0.1
    low, high = posterior.prediction.interval(0.9)
    assert ((low <= truth) & (truth <= high)).mean() > 0.85


def test_measured_machines_are_known_and_others_less_so():
    machines = family()
    posterior = fit(machines, observations(FEW, amdahl(machines, 0.1)[FEW]))
    assert posterior.measured.sum() == 5
    assert posterior.sd[posterior.measured].max() < 0.05 < posterior.sd[~posterior.measured].max() + 0.03
    assert (posterior.sd[~posterior.measured] > posterior.sd[posterior.measured].min()).all()


def test_without_a_sample_nothing_is_known():
    posterior = fit(family(), observations([], []))
    assert not posterior.measured.any()
    assert posterior.extrapolated.all()
    assert posterior.sd.min() > 3


def test_one_sample_leaves_the_others_open():
    posterior = fit(family(), observations([3], [1.0]))
    assert posterior.mean[3] == pytest.approx(0.0, abs=0.02)
    assert posterior.sd[~posterior.measured].min() > posterior.sd[3]
    assert np.isfinite(posterior.prediction.quantile(0.9)).all()


def test_all_equal_samples_are_no_trouble():
    posterior = fit(family(), observations(FEW, [2.0] * 5))
    assert np.abs(posterior.mean - np.log(2.0)).max() < 0.25
    assert np.isfinite(posterior.sd).all()


def test_contradictory_repeats_widen_what_is_said_of_the_machine():
    machines = family()
    agreeing = fit(machines, observations([3, 3], [1.0, 1.01]))
    contradictory = fit(machines, observations([3, 3], [1.0, 3.0]))
    assert contradictory.sd[3] > 5 * agreeing.sd[3]
    assert contradictory.mean[3] == pytest.approx(np.log(np.sqrt(3.0)), abs=0.2)


def test_a_lower_bound_raises_the_prediction():
    machines = family()
    truth = amdahl(machines, 0.1)
    plain = fit(machines, observations([3, 10], truth[[3, 10]]))
    bounded = fit(
        machines,
        observations([3, 10, 0], [*truth[[3, 10]], 2 * float(np.exp(plain.mean[0]))], None, [False, False, True]),
    )
    assert bounded.mean[0] > plain.mean[0] + 0.3
    assert not bounded.measured[0]


def test_a_lower_bound_far_below_changes_nothing():
    machines = family()
    plain = fit(machines, observations([3, 10], [1.0, 1.0]))
    bounded = fit(machines, observations([3, 10, 0], [1.0, 1.0, 1e-6], None, [False, False, True]))
    assert bounded.mean == pytest.approx(plain.mean, abs=0.02)


@pytest.mark.parametrize("latency_s", [0.0, -1.0, float("inf"), float("nan")])
def test_impossible_latencies_are_refused(latency_s):
    with pytest.raises(ValueError, match="positive and finite"):
        observations([0], [latency_s])


def test_draws_have_the_moments_of_the_posterior():
    machines = family()
    posterior = prepare(machines, draws=4096).fit(observations(FEW, amdahl(machines, 0.1)[FEW]))
    assert np.abs(posterior.draws.mean(0) - posterior.mean).max() < 0.25 * posterior.sd.max()
    assert posterior.draws.std(0)[~posterior.measured] == pytest.approx(posterior.sd[~posterior.measured], rel=0.25)


def test_draws_of_latency_and_metric_are_independent():
    draws = fit(family(), observations([0, 3, 6], amdahl(family(), 0.1)[[0, 3, 6]])).draws
    other = independent(draws)
    together = [np.corrcoef(draws[:, i], other[:, i])[0, 1] for i in range(draws.shape[1])]
    assert np.abs(together).max() < 0.2
    assert np.abs(together).mean() < 0.08
    assert np.array_equal(np.sort(other, axis=0), np.sort(draws, axis=0))


def test_a_fit_of_one_family_is_little_work():
    """About 0.2 when this was written; a millisecond is a quarter."""
    space, samples = prepare(family()), observations(FEW, amdahl(family(), 0.1)[FEW])
    space.fit(samples)
    assert work_of(lambda: space.fit(samples), 10) < 2.5


def test_of_too_many_kinds_the_most_frequent_are_kept(monkeypatch):
    code = np.array([7, 7, 7, 3, 3, 9, -1])
    assert kernels.one_hot(code).tolist() == [[0, 1, 0]] * 3 + [[1, 0, 0]] * 2 + [[0, 0, 1], [0, 0, 0]]
    monkeypatch.setattr(kernels, "MOST_NUMBERS", 2 * len(code))
    assert kernels.one_hot(code).tolist() == [[0, 1]] * 3 + [[1, 0]] * 2 + [[0, 0]] * 2


def off_by(off: float, errors: list[float] | None = None, left: int | None = None) -> Posterior:
    """The posterior of eight machines of a family, each up to `off` from a scaling law, without the one that is `left`."""
    at = np.array([one for one in (0, 2, 4, 7, 9, 11, 13, 16) if one != left])
    moved = dict(zip((0, 2, 4, 7, 9, 11, 13, 16), np.random.default_rng(3).uniform(-1, 1, 8), strict=True))
    latency = amdahl(family(), 0.1)[at] * np.exp(off * np.array([moved[one] for one in at.tolist()]))
    return fit(family(), observations(at, latency, errors))


def test_what_the_others_say_is_that_of_fits_without_each_machine() -> None:
    found = off_by(0.15).left_out
    assert found is not None
    for i, left in enumerate(found.at.tolist()):
        without = off_by(0.15, left=left)
        assert found.prediction.mu[i] == pytest.approx(without.mean[left], abs=0.02)
        assert found.prediction.sigma[i] == pytest.approx(without.sd[left], rel=0.1)


def test_machines_that_were_not_measured_are_as_uncertain_as_left_out_ones_err() -> None:
    held, off = off_by(0.0), off_by(0.5)
    assert held.left_out is not None
    assert off.left_out is not None
    assert held.left_out.factor == 1
    factor = off.left_out.factor
    assert 1 < factor <= FACTORS[-1]
    others = off.left_out.prediction
    assert others.covers(off.left_out.log_measured, 0.9).sum() < 7
    assert others.widened(factor).covers(off.left_out.log_measured, 0.9).sum() >= 7
    assert others.widened(factor - 0.1).covers(off.left_out.log_measured, 0.9).sum() < 7
    assert off.prediction.sigma[off.measured] == pytest.approx(off.sd[off.measured], rel=1e-8)
    assert off.prediction.sigma[~off.measured] == pytest.approx(factor * off.sd[~off.measured], rel=1e-8)


def test_few_left_out_machines_say_nothing_of_ranges() -> None:
    few = fit(family(), observations([0, 4, 9, 16], [1.0, 9.0, 0.1, 5.0]))
    assert few.left_out is not None
    assert few.left_out.factor == 1
    assert fit(family(), observations([], [])).left_out is None
