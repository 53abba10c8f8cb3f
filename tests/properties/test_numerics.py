"""Laws of the surrogate and of the choice, whatever was measured."""

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fogspec.numerics.acquisition import Policy, propose_batch
from fogspec.numerics.observations import observations
from fogspec.numerics.surrogate import prepare
from tests.support.machines import family, rule_over, selected

MACHINES = family()
SPACE = prepare(MACHINES, draws=64)
PRICE = MACHINES.price_usd_per_hour

samples = st.lists(
    st.tuples(st.integers(0, len(MACHINES) - 1), st.floats(1e-6, 1e6), st.booleans()), min_size=1, max_size=12
)


def fitted(rows):
    at, latency, bound = zip(*rows, strict=True)
    return SPACE.fit(observations(list(at), list(latency), None, list(bound)))


@given(samples)
def test_whatever_was_measured_predictions_are_finite_and_wide(rows):
    posterior = fitted(rows)
    assert np.isfinite(posterior.mean).all()
    assert (posterior.sd > 0).all()
    low, high = posterior.prediction.interval(0.9)
    assert (low <= high).all()


@given(samples, st.randoms())
def test_the_order_of_samples_does_not_matter(rows, random):
    shuffled = random.sample(rows, len(rows))
    one, other = fitted(rows), fitted(shuffled)
    assert np.allclose(one.mean, other.mean, rtol=1e-6, atol=1e-6)
    assert np.allclose(one.sd, other.sd, rtol=1e-5, atol=1e-6)


@given(samples, st.floats(0.01, 100))
def test_the_unit_of_time_does_not_matter(rows, factor):
    one, other = fitted(rows), fitted([(at, latency * factor, bound) for at, latency, bound in rows])
    assert np.allclose(one.mean + np.log(factor), other.mean, atol=1e-5)


@given(samples, st.floats(0, 1), st.floats(1e-4, 1e4))
def test_what_is_chosen_meets_the_limits_with_the_required_probability(rows, alpha, limit_s):
    posterior = fitted(rows)
    rule = rule_over(MACHINES, alpha=alpha, metric_scale=1.0, cost_scale=1.0, max_latency_s=limit_s)
    chosen = selected(posterior, rule)
    if chosen.best is not None:
        assert chosen.probability(chosen.best) >= 0.9 - 1e-6
    batch = propose_batch(posterior, chosen.utility(), sample_cost=PRICE)
    times = Counter(at for at, _, bound in rows if not bound)
    tried = {at for at, _, _ in rows}
    assert all(at not in tried or 0 < times[at] < Policy().each for at in batch.machines)
    assert bool(batch.machines) == bool(batch.gains) or not posterior.measured.any()
