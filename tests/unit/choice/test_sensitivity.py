"""What a choice hangs on: limits that bind, samples that matter, machines of which little is known."""

import numpy as np
import pytest

from fogspec.choice.choose import choose
from fogspec.choice.sensitivity import Refits, influences, parts, slacks, widest_intervals
from fogspec.language.schema import Application
from fogspec.model.fit import targets
from fogspec.model.predict import PredictionSet, predict
from tests.bench_choice import application, measured, offers

FEW = offers(60, 3)
MODELS = measured()


def limited(latency: float | None = 3.0, cost: float | None = None) -> Application:
    app = application()
    constraints = app.spec.constraints.model_copy(update={"latency": latency, "cost": cost, "confidence": 0.5})
    return app.model_copy(update={"spec": app.spec.model_copy(update={"constraints": constraints})})


def predicted() -> PredictionSet:
    return predict(MODELS, FEW, ["latency"])


@pytest.mark.parametrize("latency", [1.3, 2.0, 4.0])
def test_the_choice_changes_where_the_limit_is_said_to(latency):
    app = limited(latency, 1e-3)
    [first, second] = slacks(choose(app, predicted()))
    assert (first.limit, second.limit) == ("latency", "cost")
    chosen = choose(app, predicted())
    if first.changes_at is not None:
        wider = choose(limited(first.changes_at * 1.0001, 1e-3), predicted())
        assert str(wider.offers.instance[wider.chosen]) != str(chosen.offers.instance[chosen.chosen])
    for name, tight in (("latency", 0.999), ("cost", 0.999)):
        bound = first if name == "latency" else second
        limits = {"latency": latency, "cost": 1e-3} | {name: bound.required * tight}
        narrower = choose(limited(**limits), predicted())
        assert narrower.chosen != chosen.chosen
    assert first.value <= first.required <= latency


def test_leaving_a_sample_out_is_the_choice_without_it():
    app = limited()
    found = predicted()
    choice = choose(app, found)
    told = influences(app, MODELS, Refits(found.space, MODELS, targets(app)), choice)
    assert {one.id for one in told} == {one.id for one in MODELS.observations}
    for one in told[:3]:
        others = [known for known in MODELS.observations if known.id != one.id]
        without = choose(app, found.space.predicted(others, [], targets(app)))
        assert one.changes_to == str(without.offers.instance[without.chosen])
        assert one.changes == (one.changes_to != str(choice.offers.instance[choice.chosen]))
    assert [one.changes for one in told] == sorted((one.changes for one in told), reverse=True)


def test_weak_spots_have_the_widest_intervals_of_what_may_be_chosen():
    choice = choose(limited(None), predicted())
    found = widest_intervals(choice)
    assert len({str(FEW.instance[one.row]) for one in found}) == len(found) == 3
    low, high = np.array([choice.latency.interval(row, 0.9) for row in range(len(FEW))]).T
    assert found[0].ratio == pytest.approx(np.max(high / low), rel=1e-4)


def test_the_parts_are_the_objective():
    app = limited()
    choice = choose(app, predicted())
    assert sum(value for _, value in parts(app, choice, choice.chosen)) == pytest.approx(
        float(choice.objective[choice.chosen])
    )
