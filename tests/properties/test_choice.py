"""Laws of the choice: limits are hard, the objective is monotone, irrelevant machines do not matter."""

import dataclasses
import functools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.choice import choose as choice
from fogspec.language.schema import Application
from fogspec.model.fit import Fitted, fit
from fogspec.model.predict import PredictionSet, predict
from fogspec.results.schema import LatencySummary, Measured, ResultsBody, results_of
from tests.bench_choice import application, offers


@functools.cache
def measured(scale: float = 1.0, hurt: float = 0.0) -> Fitted:
    """Nine samples of a workload that halves with every doubling, and loses `hurt` a vCPU."""
    records = [
        Measured(id=f"s{c:g}-{m:g}", machine=Machine(infra="aws/r", instance=f"s{c:g}-{m:g}", cpus=c, memory=m, price=0.1),
                 measured_on="x", state="ok", requests=9, latency=LatencySummary(mean=scale * (0.5 + 8 / c + hurt * c)),
                 duration=9.0, spent=0.0)
        for c in (2.0, 16.0, 128.0) for m in (2 * c, 4 * c, 8 * c)
    ]  # fmt: skip
    body = ResultsBody(inputs={}, runner="x", samples=records)
    return fit(application(), results_of(body))


MODELS = measured()
HURT = measured(hurt=0.02)


def with_limits(latency: float | None, cost: float | None, alpha: float) -> Application:
    app = application()
    scale = app.spec.objective.scale.model_copy(update={"latency": 1.0, "cost": 1e-3})
    spec = app.spec.model_copy(update={
        "constraints": app.spec.constraints.model_copy(update={"latency": latency, "cost": cost}),
        "objective": app.spec.objective.model_copy(update={"alpha": alpha, "scale": scale}),
    })  # fmt: skip
    return app.model_copy(update={"spec": spec})


@functools.cache
def among(seed: int, count: int = 60) -> Catalog:
    return offers(count, seed)


# By the identity of models and catalog, which are kept, so that no others have it.
PREDICTED: dict[tuple[int, int], tuple[Fitted, Catalog, PredictionSet]] = {}


def predictions(models: Fitted, catalog: Catalog) -> PredictionSet:
    """They depend on nothing else, and take most of a choice's time."""
    key = id(models), id(catalog)
    if key not in PREDICTED:
        PREDICTED[key] = models, catalog, predict(models, catalog, ["latency"])
    return PREDICTED[key][2]


def choose(app: Application, models: Fitted, catalog: Catalog) -> choice.Choice:
    return choice.choose(app, predictions(models, catalog))


seeds = st.integers(0, 200)
alphas = st.floats(0, 1)
limits = st.one_of(st.none(), st.floats(0.3, 10))
costs = st.one_of(st.none(), st.floats(1e-5, 1e-2))


@given(seeds, limits, costs, alphas, st.sampled_from([MODELS, HURT]))
def test_the_choice_meets_every_limit_and_nothing_feasible_is_better(seed, latency, cost, alpha, models):
    found = choose(with_limits(latency, cost, alpha), models, among(seed))
    if found.chosen is None:
        assert not found.feasible.any()
        assert found.violations or not found.eligible.any()
        return
    assert latency is None or found.latency.value[found.chosen] <= latency
    assert cost is None or found.cost_usd_per_request[found.chosen] <= cost
    best = found.objective[found.feasible].min()
    assert found.objective[found.chosen] <= best + 1e-9 * abs(best)


@given(seeds, limits, costs, st.floats(0.01, 0.99))
def test_the_choice_is_on_the_front(seed, latency, cost, alpha):
    found = choose(with_limits(latency, cost, alpha), MODELS, among(seed))
    if found.chosen is not None:
        on_front = {(found.metric_value[r], found.cost_usd_per_request[r]) for r in found.front}
        assert (found.metric_value[found.chosen], found.cost_usd_per_request[found.chosen]) in on_front


@given(seeds, limits, costs, alphas, alphas)
def test_more_alpha_never_gives_more_latency(seed, latency, cost, one, other):
    low, high = sorted((one, other))
    first, second = (choose(with_limits(latency, cost, a), MODELS, among(seed)) for a in (low, high))
    if first.chosen is not None and second.chosen is not None:
        assert second.latency.value[second.chosen] <= first.latency.value[first.chosen] * (1 + 1e-9)


@given(seeds, st.floats(0.3, 10), st.floats(1, 5), costs, alphas)
def test_a_tighter_limit_never_gives_a_better_score(seed, latency, wider, cost, alpha):
    tight, loose = (choose(with_limits(x, cost, alpha), MODELS, among(seed)) for x in (latency, latency * wider))
    if tight.chosen is not None:
        assert loose.chosen is not None
        assert tight.objective[tight.chosen] >= loose.objective[loose.chosen] * (1 - 1e-9)


@given(seeds, alphas)
def test_a_machine_that_is_worse_in_everything_never_changes_the_choice(seed, alpha):
    app = application()
    without_scales = app.model_copy(update={"spec": app.spec.model_copy(update={
        "objective": app.spec.objective.model_copy(update={"alpha": alpha})})})  # fmt: skip
    few = among(seed, 40)
    before = choose(without_scales, MODELS, few)
    assert before.chosen is not None or not before.feasible.any()
    if before.chosen is None:
        return
    dear = few.price_usd_per_hour.copy()
    worst = int(np.argmax(before.objective))
    dear[worst] *= 100

    after = choose(without_scales, MODELS, dataclasses.replace(few, price_usd_per_hour=dear))
    if worst != before.chosen:
        assert after.chosen == before.chosen


# A model is fitted for each scale of latencies, not for each example.
@given(seeds, alphas, st.sampled_from([float(one) for one in np.geomspace(0.01, 100, 14)]), st.floats(0.01, 100))
def test_units_do_not_matter(seed, alpha, seconds, dollars):
    """Scaling all latencies and prices, with the limits, changes nothing."""

    few = among(seed, 40)
    # Where the price includes disk and address: those of other clouds are not scaled.
    few = dataclasses.replace(few, cloud=np.full(len(few), "lambda", dtype=object))
    priced = dataclasses.replace(few, price_usd_per_hour=few.price_usd_per_hour * dollars)
    base = with_limits(3.0, 0.01, alpha)
    spec = base.spec
    scaled = base.model_copy(update={"spec": spec.model_copy(update={
        "constraints": spec.constraints.model_copy(update={"latency": 3.0 * seconds, "cost": 0.01 * seconds * dollars}),
        "objective": spec.objective.model_copy(update={"scale": spec.objective.scale.model_copy(
            update={"latency": seconds, "cost": 1e-3 * seconds * dollars})}),
    })})  # fmt: skip
    one = choose(base, MODELS, few)
    other = choose(scaled, measured(seconds), priced)
    if one.chosen is None or other.chosen is None:
        assert one.chosen == other.chosen
    else:
        assert np.isclose(one.objective[one.chosen], other.objective[other.chosen], rtol=1e-5)


@given(seeds, limits, costs, alphas, st.floats(0.05, 0.98), st.floats(0.05, 0.98))
def test_less_confidence_never_gives_a_worse_score(seed, latency, cost, alpha, one, other):
    low, high = sorted((one, other))
    apps = [with_limits(latency, cost, alpha), with_limits(latency, cost, alpha)]
    apps = [
        app.model_copy(update={"spec": app.spec.model_copy(update={
            "constraints": app.spec.constraints.model_copy(update={"confidence": c})})})
        for app, c in zip(apps, (low, high), strict=True)
    ]  # fmt: skip
    less, more = (choose(app, MODELS, among(seed)) for app in apps)
    if more.chosen is not None:
        assert less.chosen is not None
        assert less.objective[less.chosen] <= more.objective[more.chosen] * (1 + 1e-9)
        assert (more.probability(more.chosen) or 0) >= high - 1e-6


@given(seeds, limits, costs, alphas, st.randoms(use_true_random=False))
def test_the_order_of_offers_does_not_matter(seed, latency, cost, alpha, random):
    app, few = with_limits(latency, cost, alpha), among(seed)
    order = list(range(len(few)))
    random.shuffle(order)
    mixed = few.take(np.array(order))
    one, other = choose(app, MODELS, few), choose(app, MODELS, mixed)
    assert (one.chosen is None) == (other.chosen is None)
    assert np.array_equal(one.latency.value[order], other.latency.value)
    if one.chosen is not None:
        assert few.machine(one.chosen).instance == mixed.machine(other.chosen).instance
