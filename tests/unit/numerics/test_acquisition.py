"""Which machines are measured next, and which is chosen."""

import itertools

import numpy as np
import pytest

from fogspec.numerics.acquisition import Policy, busy, choose, next_wave, provisioned
from fogspec.numerics.samples import observations
from fogspec.numerics.surrogate import fit, prepare
from tests.support.machines import amdahl, family
from tests.support.relative import work_of

MACHINES = family()
TRUTH = amdahl(MACHINES, 0.05)
PRICE = MACHINES.price_usd_per_hour


def objective(alpha=0.5, **limits):
    return busy(PRICE, alpha=alpha, scale_latency_s=1.0, scale_cost_usd=1e-4, **limits)


def campaign(wanted, policy=None, left=np.inf):
    space, at, latencies = prepare(MACHINES), [], []
    while True:
        posterior = space.fit(observations(at, latencies))
        wave = next_wave(posterior, wanted, sample_cost=PRICE, left=left - PRICE[at].sum(), policy=policy)
        if not wave.machines:
            return posterior, at, wave.reason
        at += wave.machines
        latencies = list(TRUTH[at])


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("limit_s", [None, 0.9])
def test_a_campaign_ends_beside_the_best_machine(alpha, limit_s):
    wanted = objective(alpha, max_latency_s=limit_s)
    posterior, at, reason = campaign(wanted)
    value = np.where(wanted.limit_s >= TRUTH, wanted.value(TRUTH), np.inf)
    chosen = choose(posterior, wanted)
    assert chosen.verified
    assert chosen.machine in at
    assert value[chosen.machine] <= 1.05 * value.min()
    assert len(at) < 12
    assert reason


def test_no_more_than_the_budget_is_spent():
    left = float(np.sort(PRICE)[:2].sum() + 0.01)
    _, at, reason = campaign(objective(1.0), left=left)
    assert PRICE[at].sum() <= left
    assert "is left" in reason


def test_no_more_than_the_most_samples_and_none_twice():
    _, at, reason = campaign(objective(1.0), Policy(worth=0.0, most=5))
    assert len(at) == len(set(at)) == 5
    assert "most allowed" in reason
    _, at, reason = campaign(objective(1.0), Policy(worth=0.0, most=1000))
    assert len(set(at)) == len(at) <= len(PRICE)


def test_waves_measure_several_machines_at_once():
    posterior = fit(MACHINES, observations([0, 3], TRUTH[[0, 3]]))
    wave = next_wave(posterior, objective(1.0), sample_cost=PRICE, policy=Policy(wave=3))
    assert len(set(wave.machines)) == 3
    assert len(wave.worth) == 3


def test_none_is_chosen_where_none_can_meet_the_limit():
    posterior, _, _ = campaign(objective(max_latency_s=1e-3))
    chosen = choose(posterior, objective(max_latency_s=1e-3))
    assert chosen.machine is None
    assert chosen.sure
    assert chosen.probability_met < 0.01


def test_a_failed_run_is_not_chosen():
    bound = [False, False, True]
    posterior = fit(MACHINES, observations([0, 3, 6], [*TRUTH[[0, 3]], 1000.0], None, bound))
    assert choose(posterior, objective(1.0)).machine in (0, 3)


def test_all_failed_is_no_confident_answer():
    posterior = fit(MACHINES, observations([0, 3], [30.0, 30.0], None, [True, True]))
    chosen = choose(posterior, objective(max_latency_s=1.0))
    assert not chosen.verified
    assert not (chosen.sure and chosen.machine is not None)


def test_provisioned_billing_pays_the_hour_and_bounds_the_rate():
    wanted = provisioned(PRICE, requests_per_second=2.0, alpha=0.0, scale_latency_s=1.0, scale_cost_usd=1e-4)
    assert wanted.value(TRUTH) == pytest.approx(PRICE / 7200 / 1e-4)
    assert (wanted.limit_s == 0.5).all()


def test_other_limits_on_a_fitted_model_are_little_work():
    """About 0.03 when this was written; a millisecond is a quarter."""
    posterior, _, _ = campaign(objective())
    choose(posterior, objective())
    alphas = itertools.cycle(np.linspace(0, 1, 20))
    assert work_of(lambda: choose(posterior, objective(float(next(alphas)), max_latency_s=1.0)), 20) < 0.25
