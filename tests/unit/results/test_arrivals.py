"""What a sample says of the latency at the rate at which requests will come: with their waiting for one another."""

import gzip
import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogspec.base import digest
from fogspec.choice.choose import Choice, choose
from fogspec.compile.decision import _rate_unknown
from fogspec.language.schema import Application
from fogspec.language.warned import sentence
from fogspec.model.fit import fit, partition
from fogspec.model.predict import predict
from fogspec.numerics.waiting import BUSY
from fogspec.results.arrivals import arrivals_in, arrivals_of, at_rate, one_by_one
from fogspec.results.io import timings_path
from fogspec.results.requests import parse_requests
from fogspec.results.schema import Arrivals, Measured, ResultsBody, results_of
from tests.bench_choice import application, offers
from tests.unit.numerics.test_waiting import simulated
from tests.unit.results.test_busy import Span, measured, rules, written

OF_EACH_FIFTH = [0.37 if n % 5 == 0 else 0.02 for n in range(1, 201)]  # 90 ms on average


def one_after_the_other(times_s: Sequence[float]) -> list[Span]:
    starts_s = np.cumsum([0.0, *times_s[:-1]]).tolist()
    return [(start_s, took_s, True) for start_s, took_s in zip(starts_s, times_s, strict=True)]


def found(folder: Path, content: bytes, rate: float = 10.0, **more: object) -> tuple[Measured, Arrivals]:
    record = measured(folder, content, **more)  # type: ignore[arg-type]
    names = {"statistic", "timeout_s", "valid", "scenarios", "workload"}
    own = rules(**{name: value for name, value in more.items() if name in names})
    arrivals = arrivals_of(record, parse_requests(io.BytesIO(content), own), own, rate)
    assert arrivals is not None
    return record, arrivals


def latency_at_rate(record: Measured, arrivals: Arrivals, statistic: str = "mean") -> float:
    """What a choice reckons for the machine that was measured."""
    (one,), _ = partition([record], statistic, {record.id: arrivals})  # type: ignore[arg-type]
    return one.at_rate(one.values["latency"])


def test_requests_one_after_the_other_wait_at_the_declared_rate(tmp_path: Path) -> None:
    record, arrivals = found(tmp_path, written(one_after_the_other(OF_EACH_FIFTH)))
    assert record.latency is not None
    assert record.latency.mean == pytest.approx(0.09)
    assert latency_at_rate(record, arrivals) == pytest.approx(0.207, rel=1e-3), "and not 90 ms"
    assert latency_at_rate(*found(tmp_path, written(one_after_the_other(OF_EACH_FIFTH)), rate=2.0)) == pytest.approx(
        0.09
    )


def test_their_order_decides_how_long_they_wait(tmp_path: Path) -> None:
    bunched = sorted(OF_EACH_FIFTH)
    assert latency_at_rate(*found(tmp_path, written(one_after_the_other(bunched)))) > 1.0


@pytest.mark.parametrize("statistic", ["p50", "p95", "p99"])
def test_a_percentile_is_of_the_time_with_the_waiting(tmp_path: Path, statistic: str) -> None:
    times_s = np.random.default_rng(3).exponential(0.05, 1000).tolist()
    content = written(one_after_the_other(times_s))
    exact = np.quantile(simulated(times_s, 0.0, 0.1), float(statistic[1:]) / 100)
    share = latency_at_rate(*found(tmp_path, content, statistic=statistic), statistic) / exact
    assert share == pytest.approx(1, rel=5e-3)


def test_failed_and_late_requests_occupy_the_machine(tmp_path: Path) -> None:
    times_s = [0.3 if n % 5 == 0 else 0.02 for n in range(200)]
    spans = [(start_s, s, s < 0.1) for start_s, s, _ in one_after_the_other(times_s)]
    waits = [latency for latency, took in zip(simulated(times_s, 0.0, 0.1), times_s, strict=True) if took < 0.1]
    # Of the 160 that succeed, each has the busy time of 1.25 requests.
    record, arrivals = found(tmp_path, written(spans), valid=0.5)
    assert latency_at_rate(record, arrivals) >= math.fsum(waits) / len(waits)
    late = found(tmp_path, written(one_after_the_other(times_s)), valid=0.5, timeout_s=0.1, statistic="p95")
    assert latency_at_rate(*late, "p95") == pytest.approx(np.quantile(simulated(times_s, 0.0, 0.1), 0.95))


def test_kinds_of_requests_have_their_weight(tmp_path: Path) -> None:
    spans = one_after_the_other([0.2 if n % 10 == 0 else 0.02 for n in range(200)])
    content = b"".join(written([one], scenario="hard" if one[1] > 0.1 else "easy") for one in spans)
    hard = found(tmp_path, content, scenarios={"easy": 1.0, "hard": 9.0})
    assert latency_at_rate(*hard) > latency_at_rate(*found(tmp_path, content, scenarios={"easy": 9.0, "hard": 1.0}))


def test_work_after_the_answer_delays_the_next_request(tmp_path: Path) -> None:
    """As `busy` says: a request of 20 ms, after which the machine is busy for 60 ms or 180 ms."""
    spans = [(0.2 * n, 0.04 if n % 2 else 0.02, True) for n in range(100)]
    requests = parse_requests(io.BytesIO(written(spans)), rules())
    record = measured(tmp_path, written(spans))
    short, long = (arrivals_of(record.model_copy(update={"busy": s}), requests, rules(), 10.0) for s in (0.09, 0.099))
    assert short is not None
    assert long is not None
    assert short.table is not None
    assert short.table[-1] > 1.0, "with both, it is busy for 90 ms of 100, and some wait"
    assert long.table != short.table


def test_several_at_a_time_waited_if_they_came_as_fast(tmp_path: Path) -> None:
    four = [(0.2 * (n // 4), 0.2, True) for n in range(80)]  # 20 a second
    record, arrivals = found(tmp_path, written(four))
    assert arrivals == Arrivals(requests_per_s=10.0, table=tuple(BUSY.tolist()))
    assert latency_at_rate(record, arrivals) == pytest.approx(0.2), "as it was measured"
    _, slower = found(tmp_path, written(four), rate=50.0)
    assert (slower.table, slower.sent_per_s) == (None, pytest.approx(79 / 3.8))


def test_an_observation_at_a_rate_errs_as_its_waiting_does(tmp_path: Path) -> None:
    times_s = np.random.default_rng(5).exponential(0.08, 400).tolist()
    record, arrivals = found(tmp_path, written(one_after_the_other(times_s)))
    (busy,), _ = partition([record], "mean", {record.id: arrivals})
    (alone,), _ = partition([record], "mean")
    assert busy.errors["latency"] >= alone.errors["latency"]
    assert arrivals.error > 2 * alone.errors["latency"]


@pytest.mark.parametrize(
    ("times_s", "busy_s"),
    [
        ([0.0] * 40, None),
        ([0.0] * 39 + [1e-9], 1e6),
        ([1e-300] * 40, 1e6),
        ([1e6] * 40, 5e-324),
        ([1e-9, 1e6] * 20, 1e-9),
        ([0.02] * 40, 1e6),
    ],
)
@pytest.mark.parametrize("rate", [1e-9, 10.0, 1e9])
def test_edited_figures_break_nothing(tmp_path: Path, times_s: list[float], busy_s: float | None, rate: float) -> None:
    content = written(one_after_the_other(times_s))
    record = measured(tmp_path, written(one_after_the_other([0.02] * 40))).model_copy(update={"busy": busy_s})
    for statistic in ("mean", "p95"):
        own = rules(statistic)
        arrivals = arrivals_of(record, parse_requests(io.BytesIO(content), own), own, rate)
        if arrivals is not None:
            choice, _ = chosen(record, arrivals, declared(rate, 0.2, 0.9))
            assert not np.isnan(choice.latency.value).any()
            assert choice.best is None or choice.latency.value[choice.best] > 0


def test_timings_that_are_not_there_tell_nothing(tmp_path: Path) -> None:
    content = written(one_after_the_other(OF_EACH_FIFTH))
    record = measured(tmp_path, content)
    assert arrivals_in([record], tmp_path, rules(), 10.0) == {}
    packed = gzip.compress(content, mtime=0)
    there = record.model_copy(update={"timings": digest.of_bytes(packed)})
    assert arrivals_in([there], tmp_path, rules(), 10.0) == {}, "missing"
    path = timings_path(tmp_path, there.id)
    path.parent.mkdir(parents=True)
    path.write_bytes(packed)
    assert list(arrivals_in([there], tmp_path, rules(), 10.0)) == [there.id]
    path.write_bytes(packed + b"x")
    assert arrivals_in([there], tmp_path, rules(), 10.0) == {}, "not as recorded"


def declared(rate: float, limit_s: float, confidence: float | None = None) -> Application:
    document = application().model_dump(mode="json", exclude_unset=True)
    document["spec"]["objective"] = {"load": {"rate": f"{rate}/s"}}
    document["spec"]["constraints"] = {"latency": f"{limit_s}s", "confidence": confidence or "none"}
    return Application.model_validate(document)


def chosen(record: Measured, arrivals: Arrivals, app: Application) -> tuple[Choice, int]:
    """The choice among machines of which one was measured, and its row."""
    catalog = offers(40)
    row = int(np.argmin(catalog.vcpus))
    here = record.model_copy(update={"machine": catalog.machine(row)})
    results = replace(results_of(ResultsBody(inputs={}, runner="x", samples=[here])), arrivals={here.id: arrivals})
    return choose(app, predict(fit(app, results), catalog, ["latency"])), row


@settings(max_examples=60)
@given(st.lists(st.floats(0.005, 0.4), min_size=40, max_size=60), st.floats(0.1, 1.3), st.floats(0.02, 2.0))
def test_what_is_bounded_is_the_latency_at_the_rate(
    tmp_path_factory: pytest.TempPathFactory, times_s: list[float], work: float, limit_s: float
) -> None:
    """On the machine that was measured, and with as much confidence as draws of its latency say."""
    rate = work * len(times_s) / math.fsum(times_s)
    folder = tmp_path_factory.mktemp("timings")
    record, arrivals = found(folder, written(one_after_the_other(times_s)), rate=rate)
    choice, row = chosen(record, arrivals, declared(rate, limit_s, 0.9))
    alone_s, latency_s = choice.rule.alone(choice.latency.value)[row], choice.latency.value[row]
    scale = alone_s / (math.fsum(times_s) / len(times_s))
    if work * scale <= 1:
        exact = simulated([scale * one for one in times_s], 0.0, 1 / rate)
        assert latency_s == pytest.approx(math.fsum(exact) / len(exact), rel=0.01)
    keeps = latency_s <= limit_s and rate * alone_s <= 1
    assert bool(choice.satisfied[row]) == keeps
    assert (choice.rule.alone(choice.latency.value) <= choice.latency.value * (1 + 1e-8)).all()
    of = choice.latency.distribution
    if of is None:
        return
    rows = np.full(1000, row)
    draws = of.alone.take(choice.latency.type_index[rows]).quantile(np.linspace(0.0005, 0.9995, 1000))
    met = (choice.rule.take(rows).at_rate(draws) <= limit_s) & (rate * draws <= 1)
    assert choice.probability(row) == pytest.approx(min(met.mean(), 0.999), abs=2e-3)


def test_requests_at_the_rate_are_those_of_a_deployment() -> None:
    requests = parse_requests(io.BytesIO(written(one_after_the_other(OF_EACH_FIFTH))), rules())
    assert one_by_one(requests)
    assert at_rate(requests, 10.0).latencies_s == pytest.approx(simulated(OF_EACH_FIFTH, 0.0, 0.1))
    four = parse_requests(io.BytesIO(written([(0.2 * (n // 4), 0.2, True) for n in range(80)])), rules())
    assert at_rate(four, 10.0) is four
    assert at_rate(parse_requests(io.BytesIO(b""), rules()), 10.0).latencies_s == []


@pytest.mark.parametrize(
    ("arrivals", "said"),
    [
        (None, "is not known for one: no raw timings of them tell it"),
        (
            Arrivals(requests_per_s=10.0, table=None, sent_per_s=4.0),
            "where they were sent several at a time, 4 a second",
        ),
    ],
)
def test_what_is_not_known_of_the_rate_is_said(arrivals: Arrivals | None, said: str, tmp_path: Path) -> None:
    record = measured(tmp_path, written(one_after_the_other(OF_EACH_FIFTH)))
    results = replace(
        results_of(ResultsBody(inputs={}, runner="x", samples=[record])),
        arrivals={record.id: arrivals} if arrivals else {},
    )
    app = declared(10.0, 0.2)
    models = fit(app, results)
    (warning,) = [sentence(one) for one in _rate_unknown(models, 10.0)]
    assert said in warning
    assert warning.startswith("how long requests wait at 10/s is not known")
