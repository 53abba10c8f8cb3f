"""What is paid for a request: the time in which at least one was open, whatever statistic of the latency is bounded."""

import io
import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.backends.protocol import SampleStatus
from fogspec.bench.record import make_record
from fogspec.catalog.cost import Costs
from fogspec.catalog.machine import Machine
from fogspec.choice.rule import Rule
from fogspec.model.fit import Observation, partition
from fogspec.plan.schema import Sample
from fogspec.results.requests import RecordRules, parse_requests
from fogspec.results.schema import Measured, ResourceUse

STATISTICS = ("mean", "p50", "p95", "p99")
PRICE = 0.36  # USD an hour, so that a second costs $0.0001
MACHINE = Machine(infra="local", instance="1cpu-1gib", cpus=1.0, memory=1.0, price=PRICE)
SAMPLE = Sample.model_construct(id="one", machine=MACHINE, reason="", task=None)

Span = tuple[float, float, bool]  # start and latency in seconds, and whether the request succeeds


def rules(statistic: str = "mean", **more: object) -> RecordRules:
    return RecordRules(**{"warmup": 0, "valid": 0.01, "statistic": statistic, "callback": "plan"} | more)  # type: ignore[arg-type]


def written(spans: Sequence[Span], **more: object) -> bytes:
    rows = [{"name": "plan", "start_s": start_s, "latency_s": s, "ok": ok, **more} for start_s, s, ok in spans]
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


def measured(
    folder: Path, content: bytes, statistic: str = "mean", use: ResourceUse | None = None, **more: object
) -> Measured:
    (folder / "timings.jsonl").write_bytes(content)
    status = SampleStatus(running=False, timings=folder / "timings.jsonl", resources=use)
    return make_record(SAMPLE, status, rules(statistic, **more), 60.0, 0.0)


def observed(record: Measured, statistic: str) -> Observation:
    (one,), rejected = partition([record], statistic)  # type: ignore[arg-type]
    assert not rejected
    return one


def usd_per_1000(record: Measured, statistic: str) -> float:
    """What a choice reckons for the machine that was measured."""
    one = observed(record, statistic)
    costs = Costs(
        price_usd_per_hour=np.array([PRICE]), spot=np.array([False]), interruptions_per_s=0.0, restart_s=0.0,
        transfer_usd=0.0, requests_per_s=None, busy_ratio=np.array([one.busy_ratio]),
    )  # fmt: skip
    latency_s = np.array([one.values["latency"]])
    cost = float(costs.per_request(latency_s)[0])
    assert costs.latency_within(cost) == pytest.approx(latency_s, rel=1e-9), "a limit is the same limit on the latency"
    return 1000 * cost


def covered_s(spans: Sequence[Span]) -> float:
    """For how long at least one is open, moment by moment."""
    edges = sorted({edge for start_s, latency_s, _ in spans for edge in (start_s, start_s + latency_s)})
    pieces = itertools.pairwise(edges)
    return sum(b - a for a, b in pieces if any(start_s <= a and b <= start_s + s for start_s, s, _ in spans))


times = st.integers(0, 400).map(lambda n: n / 16)  # exact: an end that is another's start leaves no gap by rounding


@given(st.lists(st.tuples(times, times.filter(bool)), min_size=100, max_size=120), st.data())
def test_cost_is_price_times_the_time_in_which_a_request_is_open(
    tmp_path_factory: pytest.TempPathFactory, series: list[tuple[float, float]], data: st.DataObject
) -> None:
    failed = data.draw(st.lists(st.tuples(times, times), max_size=20))
    spans = [(*one, True) for one in series] + [(*one, False) for one in failed]
    spans.sort(key=lambda one: one[0] + one[1])  # as the probe writes them, at their end
    record = measured(tmp_path_factory.mktemp("timings"), written(spans))
    right = PRICE / 3600 * covered_s(spans) / len(series) * 1000
    for statistic in STATISTICS:
        assert usd_per_1000(record, statistic) == pytest.approx(right, rel=1e-6), statistic


def test_a_percentile_is_not_what_is_paid(tmp_path: Path) -> None:
    spans, at_s = [], 0.0
    for n in range(200):
        spans.append((at_s, 0.3 if n % 4 == 0 else 0.02, True))
        at_s += 0.31
    record = measured(tmp_path, written(spans))
    assert record.latency is not None
    assert (record.latency.p50, record.latency.p95) == (0.02, 0.3)
    assert [usd_per_1000(record, statistic) for statistic in STATISTICS] == [pytest.approx(0.0090, rel=1e-9)] * 4


def test_requests_at_the_same_time_share_the_machine(tmp_path: Path) -> None:
    four = [(0.2 * (n // 4), 0.2, True) for n in range(80)]
    record = measured(tmp_path, written(four))
    assert record.busy == pytest.approx(0.05)
    assert usd_per_1000(record, "mean") == pytest.approx(0.005)


def test_failed_requests_are_paid_by_those_that_succeed(tmp_path: Path) -> None:
    spans = [(float(n), 0.5, n % 2 == 0) for n in range(40)]
    assert measured(tmp_path, written(spans)).busy == pytest.approx(1.0)


def test_requests_without_their_start_follow_one_another(tmp_path: Path) -> None:
    spans = [(0.0, 0.5, n % 2 == 0) for n in range(40)]
    assert measured(tmp_path, written(spans, start_s=None)).busy == pytest.approx(1.0)


def test_kinds_of_requests_are_weighted_as_their_latency_is(tmp_path: Path) -> None:
    rows = [(float(n), 1.0 if n % 4 == 0 else 0.1) for n in range(40)]
    content = b"".join(written([(*row, True)], scenario="hard" if row[1] == 1.0 else "easy") for row in rows)
    record = measured(tmp_path, content, scenarios={"easy": 1.0, "hard": 1.0})
    assert record.busy == pytest.approx(0.55)
    left_out = content + written([(100.0, 50.0, True)], scenario="other")
    assert measured(tmp_path, left_out, scenarios={"easy": 1.0, "hard": 1.0}).busy == pytest.approx(0.55)


def test_a_late_request_took_at_least_so_long(tmp_path: Path) -> None:
    """It has failed, and is not left out of the percentile that it is there to bound."""
    spans = [(float(n), 0.4 if n % 33 == 0 else 0.02, True) for n in range(200)]
    record = measured(tmp_path, written(spans), "p99", timeout_s=0.1, valid=0.9)
    assert record.latency is not None
    assert (record.state, record.requests, record.failed_requests) == ("ok", 193, 7)
    assert record.latency.p99 == pytest.approx(0.4)
    assert (record.latency.mean, record.latency.p50) == (pytest.approx(0.02), 0.02)
    assert record.busy == pytest.approx((193 * 0.02 + 7 * 0.4) / 193)


def test_a_request_without_a_response_was_waited_for(tmp_path: Path) -> None:
    content = written([(float(n), 0.02, True) for n in range(190)])
    content += b"".join(written([(200.0 + n, 0.0, False)], lost=True) for n in range(10))
    record = measured(tmp_path, content, "p99", timeout_s=0.5, valid=0.9)
    assert record.latency is not None
    assert (record.state, record.lost, record.latency.p99, record.latency.p50) == ("ok", 10, 0.5, 0.02)
    assert record.busy == pytest.approx((190 * 0.02 + 10 * 0.5) / 190)
    never = measured(tmp_path, content, "p99", valid=0.9)
    assert never.latency is not None
    assert never.latency.p99 == 0.02, "without a timeout it is not known how long one was waited for"


def used(cpu_s: float, vcpus: float = 1.0, window_s: float = 8.0) -> ResourceUse:
    mean = cpu_s / window_s
    return ResourceUse(
        window=window_s, vcpus=vcpus, cpu_mean=mean, cpu_max=max(mean, vcpus), memory_peak=0.1, minor_faults=0,
        major_faults=0, overhead=0.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("use", "workload", "busy_s", "says"),
    [
        (
            used(8.0),
            False,
            0.2,
            "180 ms of CPU time a request, at least, was used while none was open: no latency has it, and",
        ),
        (used(8.0, vcpus=2.0), False, 0.18, "160 ms of CPU time"),
        (
            used(8.0),
            True,
            0.02,
            "180 ms of CPU time a request, at least, was used while none was open: no latency has it",
        ),
        (used(0.8), False, 0.02, None),
        (used(1.1), False, 0.02, None),  # a node that polls
        (used(16.0, vcpus=2.0), False, 0.2, "360 ms of CPU time"),  # two threads: no longer than there is time for
        (None, False, 0.02, None),
    ],
)
def test_work_after_the_answer_is_said_and_paid(
    tmp_path: Path, use: ResourceUse | None, workload: bool, busy_s: float, says: str | None
) -> None:
    after = written([(0.2 * n, 0.02, True) for n in range(40)])
    record = measured(tmp_path, after, use=use, workload=workload)
    assert record.latency is not None
    assert (record.state, record.latency.mean, record.busy) == ("ok", pytest.approx(0.02), pytest.approx(busy_s))
    if says is None:
        assert record.detail is None
    else:
        assert record.detail is not None
        assert says in record.detail
        assert record.detail.endswith("is paid") is not workload


def test_more_cpus_than_it_has_are_no_work_between_requests(tmp_path: Path) -> None:
    always = written([(0.2 * n, 0.2, True) for n in range(40)])
    record = measured(tmp_path, always, use=used(15.6))
    assert record.busy == pytest.approx(0.2)
    assert str(record.detail).startswith("its processes used 1.95 vCPUs on average")


def test_what_the_probe_does_between_requests_is_no_work(tmp_path: Path) -> None:
    short = written([(0.0001 * n, 0.00001, True) for n in range(1000)])
    record = measured(tmp_path, short, use=used(0.1, window_s=0.1))
    assert (record.detail, record.busy) == (None, pytest.approx(0.00001))


def test_a_request_under_way_at_the_end_is_open() -> None:
    start = {"open": "plan", "process": "7-a", "number": 2, "start_s": 1.0}
    ended = {"name": "plan", "process": "7-a", "number": 1, "start_s": 0.0, "latency_s": 1.0, "ok": True}
    lines = [{**start, "number": 1, "start_s": 0.0}, ended, start]
    content = "".join(json.dumps(one) + "\n" for one in lines).encode()
    found = parse_requests(io.BytesIO(content), rules(), until_s=3.0)
    assert (found.latencies_s, found.open_s, found.busy_s(1.5)) == ([1.0, 2.0], 3.0, 1.5)


def test_a_rate_is_kept_up_by_what_a_machine_is_busy_for() -> None:
    costs = Costs(
        price_usd_per_hour=np.ones(2), spot=np.zeros(2, dtype=bool), interruptions_per_s=0.0, restart_s=0.0,
        transfer_usd=0.0, requests_per_s=10.0, busy_ratio=np.array([0.25, 9.0]),
    )  # fmt: skip
    rule = Rule(costs=costs, names=np.array(["four at once", "slow now and then"]), alpha=0.5, confidence=None)
    latency_s = np.array([0.2, 0.02])
    assert rule.limited(latency_s, {})["rate"] == pytest.approx([0.05, 0.18])
    assert (latency_s <= rule.latency_budget_s).tolist() == [True, False]
    assert rule.take(np.array([1])).latency_budget_s == pytest.approx([0.1 / 9])
