"""Fitted models: what counts as a sample, what a prediction is worth, and that nothing is guessed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogspec.catalog.machine import Gpu, Machine
from fogspec.language.warned import sentence
from fogspec.model import predict as predicting
from fogspec.model.fit import fit
from fogspec.results.schema import LatencySummary, Measured, ResourceUse, Results, ResultsBody, results_of
from tests.bench_choice import application, offers


def predict(models, catalog):
    return predicting.predict(models, catalog, ["latency"]).targets["latency"]


SHAPES = [(c, c * r) for c in (2.0, 16.0, 64.0) for r in (2.0, 4.0, 8.0)]


def record(cpus: float, memory: float, mean: float | None, **more) -> Measured:
    gpu = more.pop("gpu", None)
    machine = Machine(infra="aws/r0", instance=more.pop("instance", f"s{cpus:g}m{memory:g}"), cpus=cpus, memory=memory,
                         gpu=gpu, price=0.1)  # fmt: skip
    latency = None if mean is None else LatencySummary(mean=mean, **more.pop("summary", {}))
    base = {"state": "ok", "requests": 50, "duration": 60.0, "spent": 0.01, "measured_on": "x"}
    return Measured(
        id=f"{cpus:g}-{memory:g}-{gpu.name if gpu else 0}", machine=machine, latency=latency, **(base | more)
    )


def results(*records: Measured) -> Results:
    body = ResultsBody(inputs={}, runner="x", samples=list(records))
    return results_of(body)


@pytest.mark.slow
@given(st.floats(0.01, 100), st.floats(0.1, 1000))
@settings(deadline=None, max_examples=30)
def test_a_noise_free_curve_is_recovered(a, b):
    models = fit(application(), results(*(record(c, m, a + b / c) for c, m in SHAPES)))
    [model] = models.curves
    assert model.memory_family == "constant"
    predicted = predict(models, offers(50))
    inside = ~predicted.extrapolated
    truth = a + b / offers(50).vcpus
    assert np.median(np.abs(predicted.value[inside] / truth[inside] - 1)) < 0.1
    low, high = np.array([predicted.interval(row, 0.9) for row in np.flatnonzero(inside)]).T
    assert np.mean((low <= truth[inside]) & (truth[inside] <= high)) > 0.6


def test_failed_samples_are_named_and_the_machine_that_failed_is_no_candidate():
    catalog = offers(50)
    failing = str(catalog.instance[0])
    good = [record(c, m, 1 + 8 / c) for c, m in SHAPES]
    bad = record(float(catalog.vcpus[0]), float(catalog.memory_gib[0]), None, instance=failing, state="failed",
                 reason="out_of_memory", detail="needs more")  # fmt: skip
    models = fit(application(), results(*good, bad))
    [one] = models.rejected
    assert one.excludes_machine
    assert sentence(one.why).endswith("does not count: out of memory: needs more")
    assert predict(models, catalog).unfit[0]


def test_a_sample_that_the_cloud_refused_says_nothing_of_the_machine():
    bad = record(2.0, 4.0, None, state="failed", reason="capacity")
    [one] = fit(application(), results(bad)).rejected
    assert not one.excludes_machine


@pytest.mark.parametrize("statistic", ["p95", "p99"])
def test_a_statistic_that_was_not_measured_is_not_made_up(statistic):
    app = application()
    spec = app.spec
    wanted = spec.constraints.model_copy(update={"statistic": statistic})
    app = app.model_copy(update={"spec": spec.model_copy(update={"constraints": wanted})})
    models = fit(app, results(record(2.0, 4.0, 1.0)))
    assert models.curves == []
    assert statistic in sentence(models.rejected[0].why)


def test_a_measured_machine_is_its_measurement_and_others_are_predicted():
    catalog = offers(50)
    inside = next(i for i in range(50) if 2 <= catalog.vcpus[i] <= 64)
    own = record(float(catalog.vcpus[inside]), float(catalog.memory_gib[inside]), 123.0,
                 instance=str(catalog.instance[inside]))  # fmt: skip
    predicted = predict(fit(application(), results(own, *(record(c, m, 1 + 8 / c) for c, m in SHAPES))), catalog)
    assert predicted.measured[inside]
    assert predicted.value[inside] == pytest.approx(123.0, rel=0.1)
    low, high = predicted.interval(inside, 0.9)
    assert low < 123.0 * 1.05
    assert high / low < 1.5


def test_gpus_have_models_of_their_own():
    t4 = Gpu(name="T4", count=1)
    with_t4 = [record(c, 4 * c, 1.6 + 0.001 * c, gpu=t4) for c in (4.0, 8.0, 16.0)]
    models = fit(application(), results(*(record(c, m, 1 + 8 / c) for c, m in SHAPES), *with_t4))
    assert [(m.gpu, m.n) for m in models.curves] == [(None, 9), ("T4:1", 3)]
    assert models.curves[1].p == 1


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_samples_are_marked_weak(count):
    models = fit(application(), results(*(record(c, m, 1.0) for c, m in SHAPES[:count])))
    [model] = models.curves
    assert model.n == count
    predicted = predict(models, offers(30))
    wide = [high / low for low, high in (predicted.interval(row, 0.9) for row in range(30))]
    assert max(wide) > 3, "one sample says little of machines of other sizes"


def test_all_equal_is_a_constant_and_needs_no_r2():
    [model] = fit(application(), results(*(record(c, m, 2.0) for c, m in SHAPES))).curves
    assert (model.cpu_family, model.memory_family, model.r2) == ("constant", "constant", None)


def test_the_interval_widens_with_confidence_and_holds_the_prediction():
    noisy = [record(c, m, (1 + 8 / c) * (1 + 0.05 * math.sin(7 * c + m))) for c, m in SHAPES]
    predicted = predict(fit(application(), results(*noisy)), offers(50))
    for row in range(50):
        narrow, wide = predicted.interval(row, 0.5), predicted.interval(row, 0.95)
        if narrow and wide:
            assert wide[0] < narrow[0] <= predicted.value[row] <= narrow[1] < wide[1]


def test_local_measurements_are_marked_extrapolated():
    local = Machine(infra="local", instance="1cpu-1gib", cpus=1.0, memory=1.0, price=0.0)
    models = fit(application(), results(*(
        record(c, 1.0, 1 / c).model_copy(update={"machine": local.model_copy(update={"cpus": c})}) for c in (1.0, 2.0, 4.0, 8.0)
    )))  # fmt: skip
    assert models.measured_on_local
    assert predict(models, offers(20)).extrapolated.all()


def test_the_error_is_the_one_in_the_record_and_without_one_a_sample_says_nothing():
    def errors(**more):
        [one] = fit(application(), results(record(2, 4, 1.0, metrics={"length": 3.0}, **more))).observations
        return one.errors

    assert errors() == {}, "nobody computed them"
    assert errors(errors={"mean": 0.02}) == {"latency": pytest.approx(0.025)}, "and servers differ"
    assert errors(errors={"p50": 0.02}, metric_errors={}) == {"latency": 10.0, "length": 10.0}
    assert errors(metric_errors={"length": 0.2}) == {"length": 0.2}


def test_a_sample_that_says_nothing_leaves_its_machine_as_unknown_as_others():
    catalog = offers(50)

    def of(row, **more):
        return record(float(catalog.vcpus[row]), float(catalog.memory_gib[row]), 1.0,
                      instance=str(catalog.instance[row]), **more)  # fmt: skip

    def ratio(*records):
        low, high = predict(fit(application(), results(*records)), catalog).interval(0, 0.9)
        return high / low

    other = of(30, errors={"mean": 0.01})
    assert ratio(of(0, errors={"mean": 0.01}), other) < 1.2
    assert ratio(of(0, errors={}), other) == pytest.approx(ratio(other), rel=0.05)
    assert ratio(other) > 1.3
    assert predict(fit(application(), results(of(0, errors={}))), catalog).interval(0, 0.9) is None


def use(cpu_mean: float, vcpus: float = 1.0, **more: float) -> ResourceUse:
    return ResourceUse(window=50.0, vcpus=vcpus, cpu_mean=cpu_mean, cpu_max=cpu_mean, memory_peak=0.1, minor_faults=0,
                       overhead=0.0, **{"major_faults": 0, **more})  # fmt: skip


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"resources": use(0.01)}, 0.01),
        ({"resources": use(0.5)}, 0.5),
        ({"resources": use(1.0)}, 1.0),
        ({"resources": use(1.0, vcpus=4.0)}, 0.25),
        ({"resources": use(0.6, outside=0.4)}, 1.0),
        ({"resources": use(0.1, major_faults=10**6)}, 1.0),
        ({"resources": use(0.25), "busy": 0.25}, 1.0),
        ({}, 1.0),
    ],
)
def test_what_more_cpus_can_shorten_is_bounded_by_the_cpu_time(more, expected):
    """Of 50 requests of 1 s in 50 s; four at a time are open for 0.25 s each."""
    [one] = fit(application(), results(record(1, 1, 1.0, **more))).observations
    assert one.at_work == pytest.approx(expected)


@pytest.mark.parametrize(("cpu_mean", "least", "most"), [(0.01, 0.95, 1.05), (0.5, 0.5, 0.9), (1.0, 0.0, 0.6)])
def test_a_node_that_waits_is_not_predicted_to_be_faster_on_more_cpus(cpu_mean, least, most):
    catalog = offers(50)
    small = int(np.argmin(catalog.vcpus))
    own = record(float(catalog.vcpus[small]), float(catalog.memory_gib[small]), 1.0, instance=str(catalog.instance[small]),
                 resources=use(cpu_mean * catalog.vcpus[small], vcpus=float(catalog.vcpus[small])))  # fmt: skip
    found = predict(fit(application(), results(own)), catalog)
    large = np.flatnonzero(catalog.vcpus >= 16 * catalog.vcpus[small])
    assert len(large)
    assert least <= np.median(found.value[large]) <= most


def test_a_metric_that_one_machine_was_measured_with_has_no_law_over_machines():
    catalog = offers(50)
    names = [
        (float(catalog.vcpus[row]), float(catalog.memory_gib[row]), str(catalog.instance[row])) for row in range(50)
    ]
    (few, many) = min(names), max(names)

    def metric(*some):
        records = [record(c, m, 1.0, instance=name, metrics={"length": value}) for (c, m, name), value in some]
        found = predicting.predict(fit(application(), results(*records)), catalog, ["latency", "length"]).targets[
            "length"
        ]
        return found.value

    assert metric((few, 40.0)) == pytest.approx(40.0)
    two = metric((few, 40.0), (many, 10.0))
    assert two[names.index(many)] == pytest.approx(10.0, rel=0.2)
    assert two[names.index(few)] > 30
