"""The account of requests: what was started has ended, is under way, or is lost, from recorded lines."""

import io
import json
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.backends.protocol import SampleStatus
from fogspec.bench.record import make_record
from fogspec.results.requests import RecordRules, Requests, parse_requests
from fogspec.results.schema import Measured
from tests.unit.bench.test_record import SAMPLE, written

RULES = RecordRules(warmup=0, valid=0.9, statistic="mean", callback="plan")


def lines(
    *requests: tuple[float, float | None], process: str = "1-a", first: int = 1, **more: Any
) -> list[dict[str, Any]]:
    """The lines of requests (start, end or None), all in seconds, in the order in which a probe writes them."""
    found = []
    for number, (start_s, end_s) in enumerate(requests, first):
        own = {"process": process, "number": number, "start_s": start_s}
        found.append((start_s, {"open": "plan", **own, **more}))
        if end_s is not None:
            found.append((end_s, {"name": "plan", **own, "latency_s": end_s - start_s, "ok": True}))
    return [line for _, line in sorted(found, key=lambda one: one[0])]


def read(found: list[dict[str, Any]], rules: RecordRules = RULES) -> Requests:
    return parse_requests(io.BytesIO("".join(f"{json.dumps(one)}\n" for one in found).encode()), rules)


def record(folder, found: list[dict[str, Any]], rules: RecordRules = RULES) -> Measured:
    return make_record(SAMPLE, SampleStatus(running=False, timings=written(folder, *found)), rules, 2.0, 0.25)


def series(n: int, latency_s: float = 0.05, every_s: float = 0.1) -> list[tuple[float, float | None]]:
    return [(every_s * k, every_s * k + latency_s) for k in range(n)]


def test_requests_that_raise_are_failed_ones(tmp_path):
    raising = [(start_s, None if k % 3 == 0 else end_s) for k, (start_s, end_s) in enumerate(series(60))]
    made = record(tmp_path, lines(*raising))
    assert (made.state, made.reason, made.requests) == ("failed", "check", 40)
    assert made.detail == "20 of 60 requests were started and never ended"
    assert (made.failed_requests, made.lost) == (20, 20)
    few = [(start_s, None if k == 30 else end_s) for k, (start_s, end_s) in enumerate(series(60))]
    made = record(tmp_path, lines(*few))
    assert (made.state, made.requests, made.failed_requests, made.lost) == ("ok", 59, 1, 1)
    assert made.detail == "requests that were started and never ended: 1"
    assert made.latency.mean == pytest.approx(0.05)


def test_one_end_for_four_starts_is_refused(tmp_path):
    batches = [(k + 0.025 * i, k + 0.115 if i == 3 else None) for k in range(20) for i in range(4)]
    made = record(tmp_path, lines(*batches))
    assert (made.state, made.reason) == ("failed", "check")
    assert str(made.detail).endswith("of 80 requests were started and never ended")


def test_a_request_under_way_when_the_sample_ends_takes_at_least_so_long(tmp_path):
    """Other threads end the sample by its number of requests: the one that is cut off is not forgotten."""
    two = [*series(30), (2.83, None)]
    made = record(tmp_path, lines(*two))
    assert (made.requests, made.detail) == (
        31,
        "requests that were under way for longer than any other, and count with that: 1",
    )
    assert made.latency.mean == pytest.approx((30 * 0.05 + 0.12) / 31)
    rules = replace(RULES, timeout_s=0.1)
    made = record(tmp_path, lines(*two), rules)
    assert (made.requests, made.lost) == (30, 1), "it is over the timeout already"


def test_one_that_is_open_for_no_longer_than_others_took_tells_nothing(tmp_path):
    made = record(tmp_path, lines(*series(30), (2.92, None)))
    assert (made.state, made.requests, made.detail, made.lost) == ("ok", 30, None, None)


def test_a_thread_that_hangs_beside_others_that_end_the_sample_is_lost(tmp_path):
    made = record(tmp_path, lines((0.0, None), *series(30)))
    assert (made.state, made.lost, made.requests) == ("ok", 1, 30)
    made = record(tmp_path, lines((0.0, None), *series(5)))
    assert (made.state, made.reason) == ("failed", "check")


def test_the_first_request_of_all_has_the_whole_time(tmp_path):
    """A node that is slower than the sample is long is too slow, not broken: its state is a timeout."""
    made = record(tmp_path, lines((0.0, 1.0), (1.0, None)), replace(RULES, warmup=1))
    assert made.state == "timeout"
    assert record(tmp_path, lines((0.0, None))).state == "timeout"


def test_starts_whose_lines_are_missing_are_lost(tmp_path):
    whole = lines(*series(40))
    cut = [one for one in whole if one["number"] not in range(5, 15)]
    made = record(tmp_path, cut)
    assert (made.state, made.reason) == ("failed", "check")
    assert read(whole[20:]).balance.lost == 0, "the end of a file, as of a deployment, is an account of its own"


def test_ends_without_a_start_are_refused_beyond_the_share_that_may_fail(tmp_path):
    stray = {"name": "plan", "unmatched": True, "process": "2-b", "at_s": 1.0, "reason": "stopped for the second time"}
    made = record(tmp_path, [*lines(*series(30)), *[stray] * 5])
    assert (made.state, made.reason, made.unmatched) == ("failed", "not_reported", 5)
    assert "5 ends of 'plan' have no start: stopped for the second time: keep what start('plan') returns" in str(
        made.detail
    )
    made = record(tmp_path, [*lines(*series(60)), stray])
    assert (made.state, made.detail) == ("ok", "responses that belong to no request: 1")
    listened = {"name": "/pose", "unmatched": True, "at_s": 1.0}
    assert record(tmp_path, [*lines(*series(30)), *[listened] * 5]).state == "ok", "those of a topic are another matter"


def test_ends_that_may_be_of_another_request_are_refused(tmp_path):
    found = [{**one, "above": 1} if "latency_s" in one and one["number"] > 25 else one for one in lines(*series(30))]
    made = record(tmp_path, found)
    assert (made.state, made.reason) == ("failed", "not_reported")
    assert "5 of 30 requests 'plan' ended while another was open in the same place" in str(made.detail)


def test_each_process_has_its_warm_up(tmp_path):
    """Eight workers load a model for a second in their first request, and the warm-up is five requests."""
    rows = [
        line
        for k in range(8)
        for line in lines((k, k + 1.1), *((10 + k + 0.2 * i, 10.1 + k + 0.2 * i) for i in range(7)), process=f"{k}-a")
    ]
    found = read(rows, replace(RULES, warmup=5))
    assert (len(found.latencies_s), found.cold) == (24, 40)
    assert max(found.latencies_s) < 0.2
    made = record(tmp_path, rows, replace(RULES, warmup=8))
    assert made.state == "timeout"
    assert made.detail == "each of 8 processes timed no more than its warm-up: spec.benchmark.warmup is 8"


def test_commands_that_time_one_name_are_told_apart(tmp_path):
    rows = [
        *lines(*series(29, 0.01), process="1-a", command="filter"),
        *lines(*series(14, 0.3), process="2-b", command="planner"),
        *lines((0.0, None), process="3-c", command="view"),
    ]
    detail = str(record(tmp_path, rows).detail)
    means = "filter: 10 ms in 29 requests; planner: 300 ms in 14 requests; view: none in 0 requests"
    assert f"3 commands time one name, on average {means}" in detail


def test_starts_of_other_names_are_not_of_this_account():
    others = [
        {**one, "open": "refine"} if "open" in one else {**one, "name": "refine"} for one in lines((0, None), (1, 2))
    ]
    assert read([*others, *lines(*series(20), process="2-b")]).balance.lost == 0


@pytest.mark.parametrize(
    "wrong", [{"number": 0}, {"number": True}, {"number": "1"}, {"number": 10**12}, {"number": 1.5}]
)
def test_a_line_that_is_no_start_is_none(wrong):
    assert read([{**lines((0, None))[0], **wrong}, *lines(*series(20), process="2-b")]).balance.lost == 0


REQUEST = st.tuples(st.floats(0.0, 100.0), st.one_of(st.none(), st.floats(0.001, 5.0)))


@given(st.lists(REQUEST, max_size=60), st.integers(0, 5), st.integers(1, 3))
def test_each_start_is_counted_once(requests, warmup, processes):
    """Ended and counted, in the warm-up, failed, under way, or open for no longer than the longest: nothing else."""
    rows = []
    for process in range(processes):
        own = [
            (start_s, None if took_s is None else start_s + took_s) for start_s, took_s in requests[process::processes]
        ]
        rows += lines(*sorted(own, key=lambda one: one[0]), process=f"{process}-a")
    found = read(rows, replace(RULES, warmup=warmup))
    ended = sum(took_s is not None for _, took_s in requests)
    assert len(found.latencies_s) - len(found.balance.under_way_s) + found.cold == ended == found.seen
    never = len(requests) - ended
    assert found.balance.lost + len(found.balance.under_way_s) <= never
    assert found.failed == found.balance.lost
    longest_s = max((took_s for _, took_s in requests if took_s is not None), default=0.0)
    if len(found.balance.under_way_s):
        assert min(found.latencies_s[-len(found.balance.under_way_s) :]) > longest_s * (1 - 1e-9)


@given(st.lists(REQUEST, min_size=1, max_size=60), st.randoms(use_true_random=False))
def test_the_order_of_lines_of_several_processes_does_not_matter(requests, chance):
    one, other = (
        lines(*((start_s, took_s and start_s + took_s) for start_s, took_s in requests), process=name)
        for name in ("1-a", "2-b")
    )
    mixed = [*one, *other]
    chance.shuffle(places := [0] * len(one) + [1] * len(other))
    sources = iter(one), iter(other)
    mixed = [next(sources[place]) for place in places]
    straight, shuffled = read([*one, *other]), read(mixed)
    assert sorted(straight.latencies_s) == sorted(shuffled.latencies_s)
    assert (straight.failed, straight.balance.lost) == (shuffled.failed, shuffled.balance.lost)
