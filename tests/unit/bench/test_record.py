"""From raw timings to a record: nothing in the file is trusted, nothing in the record is guessed."""

import gzip
import json
import random
import statistics
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.backends.protocol import SampleStatus
from fogspec.bench import record as recording
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample
from fogspec.results.requests import RecordRules
from fogspec.results.schema import ResourceUse
from fogspec.results.statistics import summary, weights

RULES = RecordRules(warmup=1, valid=0.9, statistic="mean", callback="work", metrics={"length": "length_m"})
MACHINE = Machine.model_construct(
    infra="local", instance="1cpu-1gib", cpus=1, memory=1.0, gpu=None, spot=False, price=0.0
)
SAMPLE = Sample.model_construct(id="one", machine=MACHINE, reason="", task=None)


def line(latency_s=0.5, ok=True, name="work", reason=None, **metrics):
    return {"name": name, "start_s": 0.0, "latency_s": latency_s, "ok": ok, "reason": reason, "metrics": metrics}


def written(folder, *records, end=""):
    path = folder / "timings.jsonl"
    path.write_text("".join(json.dumps(record) + "\n" for record in records) + end)
    return path


def record(folder, *records, rules=RULES, progress=None, end=""):
    progress = progress or SampleStatus(running=False)
    path = written(folder, *records, end=end)
    ended = SampleStatus(
        running=False, timings=path, reason=progress.reason, detail=progress.detail, waited_s=progress.waited_s
    )
    return recording.make_record(SAMPLE, ended, rules, 2.0, 0.25)


def test_warm_up_counts_neither_in_latency_nor_in_metrics(tmp_path):
    made = record(tmp_path, line(99, length_m=99), line(0.2, length_m=3), line(0.4, length_m=5))
    assert (made.state, made.requests, made.latency.mean) == ("ok", 2, pytest.approx(0.3))
    assert made.metrics == {"length": 4.0}


def test_failed_requests_in_warm_up_are_forgiven_and_later_ones_are_not(tmp_path):
    assert record(tmp_path, line(ok=False), line()).state == "ok"
    made = record(tmp_path, line(), *[line()] * 8, *[line(0.001, ok=False, reason="no path")] * 2)
    assert (made.state, made.reason, made.failed_requests) == ("failed", "check", 2)
    assert made.detail == "2 of 10 requests failed their check: no path"
    assert made.latency.mean == 0.5, "fast nonsense is in no statistic"
    assert record(tmp_path, line(), *[line()] * 9, line(ok=False)).state == "ok"


def test_other_names_are_said_when_the_one_asked_for_is_missing(tmp_path):
    made = record(tmp_path, *[line(name="wrok")] * 9, line(name="scan"))
    assert (made.state, made.reason) == ("failed", "not_reported")
    assert "no request named 'work' was timed, only 'wrok', 'scan'" in made.detail
    assert record(tmp_path, line(name="scan"), line(), line()).state == "ok"
    assert record(tmp_path, line(name="scan"), line()).state == "timeout", "one request, which is warm-up"


def test_a_reason_that_the_machine_gave_stands_and_measurements_are_kept(tmp_path):
    made = record(tmp_path, line(), line(), progress=SampleStatus(running=False, reason="crash", detail="exit code 3"))
    assert (made.state, made.reason, made.detail, made.requests) == ("failed", "crash", "exit code 3", 1)


def test_nothing_after_warm_up_is_a_timeout_with_a_lower_bound(tmp_path):
    made = record(tmp_path, line(), progress=SampleStatus(running=False, waited_s=7.5))
    assert (made.state, made.latency_lower_bound, made.latency) == ("timeout", 7.5, None)


def answered(*ends_s: float, latency_s: float = 0.01) -> list[dict[str, Any]]:
    return [{**line(latency_s), "start_s": end_s - latency_s} for end_s in ends_s]


@pytest.mark.parametrize(
    ("ends_s", "waited_s", "timeout_s", "hangs"),
    [
        ((1.0, 1.1, 1.2), 12.0, None, True),  # the ten requests of the next second never came
        ((1.0, 1.1, 1.2), 0.9, None, False),  # a busy machine makes such pauses
        ((1.0, 6.0, 11.0), 14.0, None, False),  # asked every five seconds, or slow
        ((1.0, 6.0, 11.0), 16.0, None, True),
        ((1.0, 6.0, 11.0), 6.5, 1.0, True),  # asked after five seconds at most, and too late after one more
        ((1.0, 6.0, 11.0), 5.5, 1.0, False),
        ((1.0, 1.1, 1.2), None, None, False),  # the client has ended
    ],
)
def test_a_node_that_hangs_does_not_count_by_what_it_did_before(tmp_path, ends_s, waited_s, timeout_s, hangs):
    rules = replace(RULES, warmup=0, timeout_s=timeout_s)
    made = record(tmp_path, *answered(*ends_s), rules=rules, progress=SampleStatus(running=False, waited_s=waited_s))
    assert made.requests == 3
    if hangs:
        assert (made.state, made.reason) == ("failed", "no_response")
        assert f"in the last {waited_s:g} s, though all processes ran: the node hangs" in made.detail
    else:
        assert (made.state, made.detail) == ("ok", None)


def test_a_share_of_the_time_may_be_lost_as_of_the_requests(tmp_path):
    rules, waited = replace(RULES, warmup=0, valid=0.5), SampleStatus(running=False, waited_s=4.0)
    made = record(tmp_path, *answered(*(1 + 0.1 * i for i in range(60))), rules=rules, progress=waited)
    assert (made.state, made.requests) == ("ok", 60)
    assert made.detail.startswith("no request was finished in the last 4 s")


def test_requests_that_resemble_each_other_tell_less(tmp_path):
    rows = [line(latency_s=0.5 + 0.1 * (n // 20 % 2), length_m=3 + n // 20 % 2) for n in range(401)]
    alike, apart = record(tmp_path, *rows), record(tmp_path, *random.Random(1).sample(rows, len(rows)))
    assert alike.requests == apart.requests == 400
    assert alike.errors["mean"] > 2 * apart.errors["mean"] > 0
    assert alike.metric_errors["length"] > 2 * apart.metric_errors["length"] > 0


def test_an_error_that_cannot_be_told_is_missing(tmp_path):
    made = record(tmp_path, *[line(0.5 + n % 3, length_m=3) for n in range(41)])
    assert made.latency.p95 is not None
    assert made.errors.keys() == {"mean", "p50"}, "no order statistic of 40 is above the 95th percentile"
    few = record(tmp_path, *[line(length_m=1) for n in range(5)])
    assert (few.state, few.errors, few.metric_errors) == ("ok", {}, {})
    assert record(tmp_path, *[line(length_m=1) for n in range(21)]).metric_errors["length"] > 0.04, "one of 20 may fail"


def test_scenarios_have_the_error_of_the_rare_one(tmp_path):
    def rows(n):
        hard = n % 40 == 30
        own = line(random.Random(n).uniform(0.4, 1.6) if hard else 0.02, length_m=2 if hard else 1 + n % 2 / 9)
        return {**own, "scenario": "hard" if hard else "easy"}

    rules = replace(RULES, scenarios={"easy": 1.0, "hard": 1.0})
    made = record(tmp_path, *map(rows, range(401)), rules=rules)
    assert made.errors["mean"] > 0.1
    one = record(tmp_path, *map(rows, range(41)), rules=rules)
    assert (one.state, one.errors) == ("ok", {}), "from one hard request nothing can be said"


@pytest.mark.parametrize(
    ("latencies_s", "said"),
    [
        ([0.02 + 0.003 * n for n in range(200)], "the second half was 178% slower than the other"),
        ([0.5] * 40 + [0.1] * 160, "the first half was 160% slower than the other"),
        ([0.02] * 80 + [3.0] + [0.02] * 119, "one of 200 requests took 43% of their time"),
        ([0.02] * 100 + [0.3] * 10 + [0.02] * 90, "requests 101 to 106 of 200 took 26% of their time"),
        ([0.02 + 0.001 * (n % 7) for n in range(200)], None),
        ([0.02 if n % 20 else 0.1 for n in range(200)], None),
        ([random.Random(n).expovariate(10) for n in range(200)], None),
        ([9.0, *[0.02] * 18], None),
    ],
)  # fmt: skip
def test_what_a_mean_hides_is_said(tmp_path, latencies_s, said):
    made = record(tmp_path, *map(line, latencies_s), rules=replace(RULES, warmup=0))
    assert (made.state, made.detail) == ("ok", said)


@pytest.mark.parametrize(
    ("cpu_mean", "window_s", "state"), [(1.95, 10.0, "failed"), (1.05, 10.0, "ok"), (1.95, 0.5, "ok")]
)
def test_processes_that_leave_their_cpus_are_refused(tmp_path, cpu_mean, window_s, state):
    figures = {
        "cpu_mean": cpu_mean,
        "cpu_max": 2.0,
        "memory_peak": 0.1,
        "minor_faults": 0,
        "major_faults": 0,
        "overhead": 0.0,
    }
    use = ResourceUse(window=window_s, vcpus=1.0, **figures)
    status = SampleStatus(running=False, timings=written(tmp_path, *[line()] * 30), resources=use)
    made = recording.make_record(SAMPLE, status, RULES, 2.0, 0.25)
    assert made.state == state
    if state == "failed":
        assert made.reason == "out_of_range"
        assert made.detail.startswith("its processes used 1.95 vCPUs on average, of 1 that they were given")


@pytest.mark.parametrize(("statistic", "needed"), [("p50", 2), ("p95", 20), ("p99", 100)])
def test_a_quantile_takes_enough_requests(tmp_path, statistic, needed):
    rules = RecordRules(warmup=0, valid=0.9, statistic=statistic)
    few = record(tmp_path, *[line()] * (needed - 1), rules=rules)
    assert (few.state, getattr(few.latency, statistic)) == ("insufficient", None)
    enough = record(tmp_path, *[line()] * needed, rules=rules)
    assert (enough.state, getattr(enough.latency, statistic)) == ("ok", 0.5)


def test_a_line_that_was_cut_off_says_nothing(tmp_path):
    made = record(tmp_path, line(), line(), end=json.dumps(line(77)))
    assert (made.requests, made.detail) == (1, None)


@pytest.mark.parametrize(
    "garbage",
    ["x", "[]", "{}", "null", '{"latency_s": true, "ok": true}', "[" * 9000, '{"latency_s": 1, "ok": 1}',
     '{"latency_s": 1' + "0" * 9000 + ', "ok": true}', '{"latency_s": 1, "ok": true, "metrics": 3}',
     "\x00\ud7ff", '{"latency_s": "1", "ok": true}', '{"metric": {}, "at_s": "now"}'],
)  # fmt: skip
def test_a_line_that_is_no_record_is_counted(tmp_path, garbage):
    made = record(tmp_path, line(), line(), end=garbage + "\n")
    assert (made.requests, made.latency.mean) == (1, 0.5)
    assert made.detail == "unreadable lines in the timings: 1"


def test_metrics_that_are_no_numbers_are_left_out(tmp_path):
    records = [line(), *[line(length_m=value) for value in (4.0, "5", None, True, {})], line()]
    assert record(tmp_path, *records).metrics == {"length": 4.0}


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ('"latency_s": 1e200', "line 4 of its timings: latency_s is 1e+200s, and must be between 0s and 1e+06s"),
        ('"latency_s": -1', "line 4 of its timings: latency_s is -1s, and must be between 0s and 1e+06s"),
        ('"latency_s": NaN', "latency_s is no finite number, and"),
        ('"latency_s": Infinity', "latency_s is no finite number, and"),
        ('"latency_s": 1' + "0" * 400, "latency_s is no finite number, and"),
        ('"latency_s": 1, "start_s": -1e300', "start_s is -1e+300s, and"),
        ('"latency_s": 1, "service_s": 1e9', "service_s is 1e+09s, and"),
        (
            '"latency_s": 1, "metrics": {"length_m": NaN}',
            "metric length is no finite number, and must be between -1e+12 and 1e+12",
        ),
        ('"latency_s": 1, "metrics": {"length_m": -1e13}', "metric length is -1e+13, and"),
    ],
)
def test_a_figure_out_of_its_range_fails_its_sample(tmp_path, wrong, why):
    made = record(tmp_path, line(), line(), line(), end=f'{{"name": "work", "ok": true, {wrong}}}\n')
    assert (made.state, made.reason) == ("failed", "out_of_range")
    assert why in made.detail
    assert made.spent == 0.25, "what was paid is booked"


def test_no_request_takes_no_time_at_all(tmp_path):
    made = record(tmp_path, line(), line(0.0), line(0.0))
    assert (made.state, made.reason) == ("failed", "out_of_range")


@pytest.mark.parametrize("figure", ["setup_s", "measured_s", "waited_s"])
def test_times_of_the_agent_are_in_their_ranges_too(tmp_path, figure):
    path = written(tmp_path, line())
    ended = SampleStatus(running=False, timings=path, **{figure: 1e300})
    made = recording.make_record(SAMPLE, ended, RULES, 2.0, 0.25)
    assert (made.state, made.reason, made.spent) == ("failed", "out_of_range", 0.25)
    assert "is 1e+300s, and must be between 0s and" in made.detail


def test_a_reason_cannot_draw_on_the_terminal(tmp_path):
    made = record(tmp_path, line(), line(ok=False, reason="\x1b[31mred\n" + "x" * 900))
    assert "\x1b" not in made.detail
    assert len(made.detail) < 300


def test_the_same_timings_are_packed_to_the_same_bytes(tmp_path):
    path = written(tmp_path, line(), line())
    packed = recording.compress(path)
    assert packed == recording.compress(path)
    assert gzip.decompress(packed) == path.read_bytes()


@given(st.lists(st.floats(0, 1e6), min_size=2, max_size=300))
def test_the_summary_is_that_of_the_textbook(values):
    made = summary(values, weights([""] * len(values), {}))
    assert made.mean == pytest.approx(statistics.fmean(values))
    assert made.sd == pytest.approx(statistics.stdev(values), abs=1e-6)
    assert made.p50 == pytest.approx(statistics.median(values))
    if made.p99 is not None:
        cuts = statistics.quantiles(values, n=100, method="inclusive")
        assert (made.p95, made.p99) == (pytest.approx(cuts[94]), pytest.approx(cuts[98]))
        assert min(values) <= made.p50 <= made.p95 <= made.p99 <= max(values)


def test_no_values_have_no_summary():
    assert summary([], []) is None


WEIGHED = RecordRules(warmup=0, valid=0.9, statistic="mean", callback="work", metrics={"length": "length_m"},
                scenarios={"easy": 3.0, "hard": 1.0})  # fmt: skip


def of(scenario, latency_s, **metrics):
    return line(latency_s, **metrics) | {"scenario": scenario}


def test_scenarios_count_as_often_as_the_spec_says_whatever_the_mix_was(tmp_path):
    made = record(tmp_path, of("easy", 1.0, length_m=2), *[of("hard", 5.0, length_m=6)] * 9, rules=WEIGHED)
    assert (made.state, made.requests) == ("ok", 10)
    assert made.latency.mean == pytest.approx((3 * 1.0 + 1 * 5.0) / 4)
    assert made.metrics == {"length": pytest.approx(3.0)}


@given(st.lists(st.floats(0, 1e3), min_size=1, max_size=20), st.integers(2, 5))
def test_repeating_a_scenario_s_requests_changes_no_weighed_mean(values, times):
    hard = [7.0, 9.0]
    once = [*values, *hard]
    often = [*(values * times), *hard]
    means = [
        summary(x, weights(["easy"] * (len(x) - 2) + ["hard"] * 2, {"easy": 2.0, "hard": 3.0})).mean
        for x in (once, often)
    ]
    assert means[0] == pytest.approx(means[1])


def test_a_scenario_without_a_request_makes_the_sample_insufficient(tmp_path):
    made = record(tmp_path, of("easy", 1.0), rules=WEIGHED)
    assert (made.state, made.detail) == ("insufficient", "no valid request of scenario hard")


def test_requests_that_name_no_scenario_are_not_guessed(tmp_path):
    made = record(tmp_path, line(), line(), rules=WEIGHED)
    assert (made.state, made.reason) == ("failed", "no_response")
    assert "easy, hard" in made.detail


PROBED = RecordRules(warmup=0, valid=0.5, statistic="mean", timeout_s=1.0, metrics={"length": "length"})


def probed(start_s, latency_s, service_s=None, **more):
    return {
        "name": "/pose",
        "start_s": start_s,
        "latency_s": latency_s,
        "service_s": service_s or latency_s,
        "ok": True,
        **more,
    }


def test_a_request_that_took_too_long_has_failed(tmp_path):
    made = record(tmp_path, probed(0, 0.5), probed(1, 1.5), rules=PROBED)
    assert (made.state, made.requests, made.failed_requests, made.lost) == ("ok", 1, 1, None)
    made = record(tmp_path, probed(0, 0.5), probed(1, 1.5), probed(3, 2), rules=PROBED)
    assert made.detail == "2 of 3 requests failed their check: took longer than 1 s"


def test_lost_requests_failed_and_foreign_responses_are_counted(tmp_path):
    lost = probed(1, 0.0) | {"ok": False, "lost": True, "reason": "no response"}
    foreign = {"name": "/pose", "unmatched": True, "at_s": 3.0}
    heard = [probed(2 + n, 0.5) for n in range(9)]
    made = record(tmp_path, probed(0, 0.5), lost, foreign, foreign, *heard, rules=PROBED)
    assert (made.requests, made.failed_requests, made.lost, made.unmatched) == (10, 1, 1, 2)
    assert (made.state, made.detail) == ("ok", "responses that belong to no request: 2")
    made = record(tmp_path, probed(0, 0.5), *[foreign] * 3, *heard, rules=PROBED)
    assert (made.state, made.reason, made.requests) == ("failed", "not_reported", 10)
    assert str(made.detail).startswith("3 responses belong to no request, beside 10 requests")


def test_what_the_probe_did_not_hear_is_not_what_the_node_missed(tmp_path):
    lost = [probed(n, 0.0) | {"ok": False, "lost": True, "reason": "no response"} for n in range(10, 20)]
    heard, missed = [probed(n, 0.5) for n in range(10)], {"missed": 12, "topic": "/pose", "sent": 20}
    made = record(tmp_path, *heard, *lost, missed | {"missed": 4}, missed, rules=PROBED)
    assert (made.state, made.reason) == ("failed", "not_reported")
    assert str(made.detail).startswith(
        "the probe heard 8 of 20 messages on /pose, and the middleware lost the others on"
    )
    assert record(tmp_path, *heard, missed | {"missed": 1, "sent": 40}, rules=PROBED).state == "ok", (
        "as many as may fail"
    )
    for wrong in ({"missed": -4}, {"missed": "10"}, {"topic": 3}, {"sent": None}, {"sent": 1e300}):
        assert record(tmp_path, *heard, missed | wrong, rules=PROBED).state == "ok", wrong


def test_waiting_is_told_from_working(tmp_path):
    made = record(tmp_path, probed(0, 0.5, 0.5), probed(0.1, 0.9, 0.5), rules=PROBED)
    assert (made.latency.mean, made.service.mean, made.detail) == (pytest.approx(0.7), 0.5, None)
    made = record(tmp_path, probed(0, 0.2, 0.2), *[probed(0, 0.2 * i, 0.2) for i in (2, 3, 4)], rules=PROBED)
    assert made.detail == "requests waited for one another: of 500 ms on average the node worked 200 ms"
    no_service = {key: value for key, value in probed(5, 0.4).items() if key != "service_s"}
    assert record(tmp_path, probed(0, 0.2), no_service, rules=PROBED).service is None


def test_a_probe_s_warning_and_its_last_one(tmp_path):
    lines = [probed(0, 0.5), {"warning": "first"}, {"note": "x"}, {"warning": "mind \x1b[1mthis"}]
    assert record(tmp_path, *lines, rules=PROBED).detail == "mind [1mthis"


def test_values_of_topics_reach_their_requests(tmp_path):
    values = [
        {"metric": {"length": 3}, "at_s": 0.51, "stamp": None},
        {"metric": {"length": 5.0}, "at_s": 9, "stamp": [2, 0]},
    ]
    made = record(tmp_path, *values, probed(0, 0.5), probed(1, 0.5, stamp=[2, 0]), rules=PROBED)
    assert made.metrics == {"length": 4.0}
    made = record(
        tmp_path, probed(0, 0.5), {"metric": {"length": "long"}, "at_s": 0.6}, {"metric": 3, "at_s": 1}, rules=PROBED
    )
    assert (made.metrics, made.detail) == ({}, "unreadable lines in the timings: 1")


def test_an_answer_that_a_client_refuses_has_failed(tmp_path):
    verdict = {"metric": {"!": "found == true does not hold: it is False"}, "at_s": 0.501, "stamp": None}
    made = record(tmp_path, probed(0, 0.5), verdict, probed(1, 0.5), rules=PROBED)
    assert (made.requests, made.failed_requests, made.metrics) == (1, 1, {})
