"""The paper's relaxed method against looking at every machine by its own curves: never better, never over a limit."""

from hypothesis import given
from hypothesis import strategies as st

from fogspec.choice.relaxed import chosen_by_relaxing, relaxed_optimum
from tests.properties.test_choice import HURT, MODELS, alphas, among, choose, costs, limits, seeds, with_limits


@given(seeds, limits, costs, alphas, st.sampled_from([MODELS, HURT]))
def test_relaxing_never_beats_the_exhaustive_choice_and_never_breaks_a_limit(seed, latency, cost, alpha, models):
    app = with_limits(latency, cost, alpha)
    every = choose(app, models, among(seed))
    found = relaxed_optimum(models, every)
    chosen = chosen_by_relaxing(every, found).chosen
    if found is None or chosen is None:
        return
    own = found.selection
    assert own.best is not None
    assert own.feasible[chosen]
    assert own.objective[chosen] >= own.objective[own.best] * (1 - 1e-9)


@given(seeds, alphas)
def test_without_limits_relaxing_ends_somewhere(seed, alpha):
    app = with_limits(None, None, alpha)
    every = choose(app, MODELS, among(seed))
    found = relaxed_optimum(MODELS, every)
    assert found is not None
    assert found.row is not None
