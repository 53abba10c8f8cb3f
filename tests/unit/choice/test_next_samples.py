"""The adaptive sampler's batches: within the budget, each type once, and the choice measured at the end."""

import numpy as np
import pytest

from fogspec.catalog.sources import load_catalog
from fogspec.catalog.table import Catalog
from fogspec.choice.choose import choose
from fogspec.choice.next_samples import best_next_sample, next_samples
from fogspec.language.schema import Application
from fogspec.model.fit import partition
from fogspec.model.predict import predict_from
from fogspec.numerics.acquisition import Policy
from fogspec.results.schema import LatencySummary, Measured
from tests.bench_choice import application


def adaptive(**constraints: object) -> Application:
    app = application()
    spec = app.spec
    return app.model_copy(update={"spec": spec.model_copy(update={
        "benchmark": spec.benchmark.model_copy(update={"sampler": "adaptive"}),
        "constraints": spec.constraints.model_copy(update=constraints),
    })})  # fmt: skip


@pytest.fixture(scope="module")
def family() -> Catalog:
    catalog = load_catalog(None, ("aws",))
    names = np.array([str(name).partition(".")[0] for name in catalog.instance])
    return catalog.take(np.isin(names, ("c6i", "m6i", "r6i")) & (catalog.region == "us-east-1"))


def record(offers: Catalog, row: int, **more: object) -> Measured:
    machine = offers.machine(row)
    latency = LatencySummary(mean=0.2 + 8 / machine.cpus + 0.004 * machine.cpus)
    base = {"state": "ok", "latency": latency, "requests": 50, "duration": 60.0, "spent": 0.0, "measured_on": "x"}
    return Measured(id=f"s{row}", machine=machine, **(base | more))


def campaign(offers: Catalog, app: Application, left: float = np.inf, batch: int = 1) -> tuple[list[Measured], str]:
    usd = offers.price_usd_per_hour * 0.2
    records: list[Measured] = []
    for _ in range(40):
        asked = next_samples(app, offers, records, usd_per_sample=usd, left_usd=left, batch=batch)
        assert len(asked.rows) == len(asked.reasons)
        assert usd[list(asked.rows)].sum() <= left * (1 + 1e-9)
        left -= float(usd[list(asked.rows)].sum())
        if not asked.rows:
            return records, asked.reason
        records += [record(offers, row) for row in asked.rows]
    raise AssertionError("it never ends")


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_a_campaign_ends_with_the_best_machine_measured(family, alpha):
    app = adaptive(latency=2.0)
    app = app.model_copy(update={"spec": app.spec.model_copy(update={
        "objective": app.spec.objective.model_copy(update={"alpha": alpha})})})  # fmt: skip
    records, reason = campaign(family, app)
    assert "improve" in reason
    names = [one.machine.instance for one in records]
    assert len(names) < 12
    assert max(map(names.count, names)) <= Policy().each
    known, unusable = partition(records, "mean")
    choice = choose(app, predict_from(known, unusable, family, ["latency"]))
    assert choice.chosen is not None
    assert choice.latency.measured[choice.chosen]
    truth = 0.2 + 8 / family.vcpus + 0.004 * family.vcpus
    cost = truth * family.price_usd_per_hour / 3600
    value = np.where(truth <= 2.0, alpha * truth / choice.scale.metric + (1 - alpha) * cost / choice.scale.cost, np.inf)
    assert value[choice.chosen] <= value.min() * 1.05


def asking(servers: int) -> Application:
    app = adaptive(latency=2.0)
    benchmark = app.spec.benchmark.model_copy(update={"servers": servers})
    return app.model_copy(update={"spec": app.spec.model_copy(update={"benchmark": benchmark})})


@pytest.mark.parametrize("servers", [2, 3])
def test_the_choice_is_measured_on_as_many_servers_as_asked(family, servers):
    app = asking(servers)
    one, _ = campaign(family, asking(1))
    records, _ = campaign(family, app)
    known, unusable = partition(records, "mean")
    choice = choose(app, predict_from(known, unusable, family, ["latency"]))
    assert choice.chosen is not None
    names = [each.machine.instance for each in records]
    assert names.count(str(family.instance[choice.chosen])) >= servers
    assert len(one) <= len(records) <= len(one) + 2 * servers


def test_a_second_server_that_cannot_be_had_or_paid_ends_sampling_and_is_said(family):
    app, usd = asking(2), family.price_usd_per_hour * 0.2
    records, _ = campaign(family, asking(1))
    once = list({one.machine.instance: one for one in records}.values())
    (row,), (why,) = (asked := next_samples(app, family, once, usd_per_sample=usd)).rows, asked.reasons
    while "on another server" not in why:
        once.append(record(family, row))
        (row,), (why,) = (asked := next_samples(app, family, once, usd_per_sample=usd)).rows, asked.reasons
    assert why == "the choice on another server, number 2 of 2"
    poor = next_samples(app, family, once, usd_per_sample=usd, left_usd=float(usd[row]) * 0.99)
    assert poor.rows == ()
    gone = record(family, row, state="failed", reason="capacity", latency=None)
    assert (
        "could not be measured on another server" in next_samples(app, family, [*once, gone], usd_per_sample=usd).reason
    )


@pytest.mark.parametrize("left", [0.0, 0.02, 0.1, 0.5])
def test_the_budget_is_never_exceeded_and_the_end_says_why(family, left):
    records, reason = campaign(family, adaptive(latency=2.0), left)
    assert "budget" in reason or "improve" in reason
    assert left > 0.1 or len(records) < 6


def test_a_machine_that_was_suspiciously_fast_is_measured_again(family):
    app = adaptive()
    app = app.model_copy(update={"spec": app.spec.model_copy(update={
        "objective": app.spec.objective.model_copy(update={"alpha": 1.0})})})  # fmt: skip
    records = [record(family, row) for row in range(len(family))]
    lucky = next(row for row in range(len(family)) if family.vcpus[row] == 32)
    records[lucky] = record(family, lucky, latency=LatencySummary(mean=records[lucky].latency.mean * 0.8))
    usd = family.price_usd_per_hour * 0.2
    asked = next_samples(app, family, records, usd_per_sample=usd)
    assert [str(family.instance[row]) for row in asked.rows] == [str(family.instance[lucky])]
    assert "measured again" in asked.reasons[0]
    honest = record(family, lucky).model_copy(update={"id": "again"})
    before, after = (
        choose(app, predict_from(*partition(some, "mean"), family, ["latency"]))
        for some in (records, [*records, honest])
    )
    assert after.latency.value[after.chosen] > before.latency.value[before.chosen]


def test_samples_that_do_not_tell_their_error_end_the_campaign(family):
    """Each further one would cost money and tell as little."""
    asked = next_samples(
        adaptive(), family, [record(family, row, errors={}) for row in (0, 1)], usd_per_sample=family.price_usd_per_hour
    )
    assert asked.rows == ()
    assert "raise spec.benchmark.stop" in asked.reason


def test_waves_measure_several_at_once(family):
    asked = next_samples(adaptive(), family, [record(family, 0)], usd_per_sample=family.price_usd_per_hour, batch=3)
    assert len(set(asked.rows)) == len(asked.rows) > 1


def test_machines_that_failed_are_not_asked_for_again_nor_those_with_less_memory(family):
    usd = family.price_usd_per_hour * 0.2
    first = next_samples(adaptive(), family, [], usd_per_sample=usd)
    failed = [record(family, row, state="failed", reason="out_of_memory", latency=None) for row in first.rows]
    most = max(one.machine.memory for one in failed)
    again = next_samples(adaptive(), family, failed, usd_per_sample=usd)
    assert again.rows
    assert all(family.memory_gib[row] > most for row in again.rows)


def test_when_nothing_can_be_measured_it_ends(family):
    usd = family.price_usd_per_hour
    tried = [record(family, row, state="failed", reason="capacity", latency=None) for row in range(len(family))]
    asked = next_samples(adaptive(), family, tried, usd_per_sample=usd)
    assert asked.rows == ()
    assert "none could be measured" in asked.reason


def test_one_more_sample_has_a_worth_and_a_price(family):
    usd = family.price_usd_per_hour * 0.2
    app = adaptive(latency=2.0)
    records = [record(family, row) for row in np.argsort(family.price_usd_per_hour)[:2]]
    known, unusable = partition(records, "mean")
    found = best_next_sample(app, predict_from(known, unusable, family, ["latency"]), [], usd)
    assert found is not None
    assert found.gain > 0
    assert found.usd == pytest.approx(usd[found.row])


def test_a_metric_in_place_of_the_latency(family):
    app = adaptive()
    objective = app.spec.objective.model_copy(update={"metric": "path_length", "alpha": 1.0})
    app = app.model_copy(update={"spec": app.spec.model_copy(update={"objective": objective})})
    usd = family.price_usd_per_hour * 0.2
    records: list[Measured] = []
    for _ in range(30):
        asked = next_samples(app, family, records, usd_per_sample=usd)
        if not asked.rows:
            break
        records += [
            record(family, row, metrics={"path_length": 10 + 20 / float(family.vcpus[row])}) for row in asked.rows
        ]
    known, unusable = partition(records, "mean")
    choice = choose(app, predict_from(known, unusable, family, ["latency", "path_length"]))
    assert choice.chosen is not None
    assert 20 / family.vcpus[choice.chosen] <= 20 / family.vcpus.max() + 0.03 * 10


@pytest.mark.parametrize(("alpha", "limits"), [(0.5, {"latency": 2.0}), (1.0, {}), (0.0, {"cost": 0.0005}), (0.3, {})])
def test_above_the_latency_that_decides_a_machine_is_no_choice_and_below_it_may_be_one(family, alpha, limits):
    app = adaptive(**{"latency": None, "cost": None, **limits})
    app = app.model_copy(update={"spec": app.spec.model_copy(update={
        "objective": app.spec.objective.model_copy(update={"alpha": alpha})})})  # fmt: skip
    records, _ = campaign(family, app)
    known, unusable = partition(records, "mean")
    choice = choose(app, predict_from(known, unusable, family, ["latency"]))
    rows = np.arange(len(family))
    above = choice.decided_above_s(rows)
    assert above is not None
    best, rule = choice.best, choice.rule
    worst = float(choice.latency.distribution.on_measured_server.quantile(0.95)[choice.latency.type_index[best]])
    least = rule.take(np.array([best])).value(np.array([worst]), choice.scale)[0]
    for factor, decided in ((1.001, True), (0.999, False)):
        latency_s = above * factor
        out = (rule.value(latency_s, choice.scale) >= least) | (latency_s > choice.latency_budget_s)
        assert (out == decided).all()


def test_nothing_decides_before_a_machine_that_meets_the_limits_is_measured(family):
    app = adaptive(latency=0.01)
    records = [record(family, row) for row in range(0, len(family), 5)]
    known, unusable = partition(records, "mean")
    choice = choose(app, predict_from(known, unusable, family, ["latency"]))
    assert choice.decided_above_s(np.arange(3)) is None
    asked = next_samples(app, family, records, usd_per_sample=family.price_usd_per_hour * 0.2)
    assert not any(asked.decided_above(n) for n in range(len(asked.rows)))
