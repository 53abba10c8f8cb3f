"""Which machines are measured next, and which is chosen."""

import itertools

import numpy as np
import pytest

from fogspec.choice.rule import Scale
from fogspec.numerics.acquisition import Policy, expected_gains, propose_batch
from fogspec.numerics.observations import observations
from fogspec.numerics.surrogate import fit, prepare
from tests.support.machines import amdahl, family, rule_over, selected
from tests.support.relative import work_of

MACHINES = family()
TRUTH = amdahl(MACHINES, 0.05)
PRICE = MACHINES.price_usd_per_hour


def asked(alpha=0.5, **more):
    return rule_over(MACHINES, alpha=alpha, metric_scale=1.0, cost_scale=1e-4, **more)


def campaign(rule, policy=None, left=np.inf):
    space, at, latencies = prepare(MACHINES), [], []
    while True:
        posterior = space.fit(observations(at, latencies))
        utility = selected(posterior, rule).utility()
        batch = propose_batch(posterior, utility, sample_cost=PRICE, left=left - PRICE[at].sum(), policy=policy)
        if not batch.machines:
            return posterior, at, batch.reason
        at += batch.machines
        latencies = list(TRUTH[at])


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("limit_s", [None, 0.9])
def test_a_campaign_ends_beside_the_best_machine(alpha, limit_s):
    rule = asked(alpha, max_latency_s=limit_s)
    posterior, at, reason = campaign(rule)
    chosen = selected(posterior, rule)
    value = np.where(rule.latency_budget_s >= TRUTH, rule.value(TRUTH, chosen.scale), np.inf)
    assert chosen.unverified is None
    assert chosen.best in at
    assert value[chosen.best] <= 1.05 * value.min()
    assert len(at) < 12
    assert reason


def test_no_more_than_the_budget_is_spent():
    left = float(np.sort(PRICE)[:2].sum() + 0.01)
    _, at, reason = campaign(asked(1.0), left=left)
    assert PRICE[at].sum() <= left
    assert "is left" in reason


def test_the_cheapest_machines_are_measured_first():
    posterior = fit(MACHINES, observations([], []))
    utility = selected(posterior, asked(1.0)).utility()
    batch = propose_batch(posterior, utility, sample_cost=PRICE)
    assert batch.machines == tuple(np.argsort(PRICE, kind="stable")[:3])
    within = propose_batch(posterior, utility, sample_cost=PRICE, left=float(np.sort(PRICE)[:2].sum()))
    assert within.machines == batch.machines[:2]


def test_no_machine_is_measured_more_often_than_the_policy_says():
    _, at, reason = campaign(asked(1.0), Policy(min_gain=0.0, each=1))
    assert len(set(at)) == len(at) <= len(PRICE)
    assert reason


def test_waves_measure_several_machines_at_once():
    posterior = fit(MACHINES, observations([0, 3], TRUTH[[0, 3]]))
    batch = propose_batch(
        posterior, selected(posterior, asked(1.0)).utility(), sample_cost=PRICE, policy=Policy(batch=3)
    )
    assert len(set(batch.machines)) == 3
    assert len(batch.gains) == 3


def test_none_is_chosen_where_none_can_meet_the_limit():
    posterior, _, _ = campaign(asked(max_latency_s=1e-3))
    chosen = selected(posterior, asked(max_latency_s=1e-3))
    assert chosen.best is None
    assert chosen.probability(chosen.most_probable) < 0.01


def test_a_failed_run_is_not_chosen():
    bound = [False, False, True]
    posterior = fit(MACHINES, observations([0, 3, 6], [*TRUTH[[0, 3]], 1000.0], None, bound))
    assert selected(posterior, asked(1.0)).best in (0, 3)


def test_all_failed_is_no_confident_answer():
    posterior = fit(MACHINES, observations([0, 3], [30.0, 30.0], None, [True, True]))
    assert selected(posterior, asked(max_latency_s=1.0)).best is None


def test_provisioned_billing_pays_the_hour_and_bounds_the_rate():
    rule = asked(alpha=0.0, requests_per_s=2.0)
    assert rule.value(TRUTH, Scale(1.0, 1e-4)) == pytest.approx(PRICE / 7200 / 1e-4)
    assert (rule.latency_budget_s == 0.5).all()
    assert rule.bounds == {"rate": 0.5}


def test_a_rule_without_sense_is_refused():
    with pytest.raises(ValueError, match="alpha"):
        asked(alpha=1.1)
    with pytest.raises(ValueError, match="positive"):
        rule_over(MACHINES, cost_scale=0.0)


def test_other_limits_on_a_fitted_model_are_little_work():
    """About 0.05 when this was written; a millisecond is a quarter."""
    posterior, _, _ = campaign(asked())
    assert selected(posterior, asked(max_latency_s=1.0)).best is not None
    alphas = itertools.cycle(np.linspace(0, 1, 20))
    assert work_of(lambda: selected(posterior, asked(float(next(alphas)), max_latency_s=1.0)).best, 20) < 0.25


def test_a_machine_that_the_model_rules_out_gains_nothing():
    at = [0, 6, 10, 17]
    posterior = prepare(MACHINES).fit(observations(at, TRUTH[at]))
    utility = selected(posterior, asked(0.5, measured_first=False)).utility()
    value, gains = utility.loss(posterior), expected_gains(posterior, utility)
    typical = np.exp(np.log(value).mean(axis=0)).min()
    never = ~posterior.measured & (value.min(axis=0) >= typical)
    assert never.any()
    assert (gains[never] == 0).all()
    assert (gains[~never & ~posterior.measured] > 0).all()


def test_a_repeat_must_gain_as_much_as_a_new_machine():
    """A sample of one of many machines costs little of a sweep over all of them: that is no reason to repeat it."""
    at = np.arange(len(MACHINES))
    machines = MACHINES.take(np.tile(at, 30))
    price = machines.price_usd_per_hour
    posterior = fit(machines, observations(at, TRUTH))
    rule = rule_over(machines, alpha=1.0, metric_scale=1.0, cost_scale=1e-4, measured_first=True)
    utility = selected(posterior, rule).utility()
    gains, needed = expected_gains(posterior, utility), Policy().min_gain * price / price.mean()
    assert 0.05 < (gains / needed)[posterior.measured].max() < 1  # a repeat tells something, and less than it costs
    assert propose_batch(posterior, utility, sample_cost=price).machines == ()
