"""Drift: what the nodes do in use against what the model predicted, in both directions."""

import json
from pathlib import Path

import pytest

from fogspec.catalog.machine import Machine
from fogspec.compile.manifest import Manifest
from fogspec.deploy.drift import LATEST, LEAST, Limit, drift, interval_s, needed, observe, unclear_text, violation_text
from fogspec.language.loader import load, read_document
from fogspec.language.schema import Application, Load
from fogspec.results.requests import RecordRules
from tests.unit.numerics.test_waiting import simulated

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("observed", "predicted", "found"),
    [
        ((1.0, 1.1), (0.9, 1.05), "none"),
        ((1.2, 1.3), (0.9, 1.1), "slower"),
        ((0.5, 0.6), (0.9, 1.1), "faster"),
        ((0.8, 1.2), (0.9, 1.1), "none"),
        (None, (0.9, 1.1), "unknown"),
        ((1.0, 1.1), None, "unknown"),
    ],
)
def test_one_interval_outside_another(observed, predicted, found) -> None:
    assert drift(observed, predicted) == found


def test_few_requests_say_nothing() -> None:
    assert interval_s([1.0] * 29, "mean") is None
    assert interval_s([1.0] * 30, "mean") == (1.0, 1.0)
    assert interval_s([1.0] * 99, "p99") is None
    assert interval_s([1.0 + n % 7 for n in range(100)], "p99") is None, "the upper end would lie beyond the sample"
    assert interval_s([float(n) for n in range(1000)], "mean") is None, "a trend"


@pytest.mark.parametrize(("statistic", "least"), [("mean", 30), ("p50", 30), ("p95", 80), ("p99", 415)])
def test_an_interval_is_known_from_the_needed_number_on(statistic: str, least: int) -> None:
    assert needed(statistic) == least
    known = [interval_s([1.0] * count, statistic) is not None for count in (least - 1, *range(least, 1001))]
    assert known == [False, *[True] * (1001 - least)]


@pytest.fixture
def paper() -> tuple:
    (loaded,) = load([ROOT / "specs/grasp-planning-recorded.yaml"])
    expected = read_document(ROOT / "compiled/grasp-planning-recorded/manifest.yaml", Manifest).expected
    latency = expected.latency.model_copy(
        update={"predicted": 1.65, "interval": (1.5, 1.8), "limit": 2.0, "network_allowance": 0.0}
    )
    return warmed(loaded.application, 0), expected.model_copy(update={"latency": latency})


def warmed(application: Application, warmup: int) -> Application:
    benchmark = application.spec.benchmark.model_copy(update={"warmup": warmup})
    return application.model_copy(update={"spec": application.spec.model_copy(update={"benchmark": benchmark})})


MACHINE = Machine(infra="aws/us-east-1", instance="g4dn.xlarge", cpus=4, memory=16.0, price=0.526)
PAID_USD_PER_HOUR = 0.526 + (0.08 * 128 + 0.005 * 500 + 0.04 * 93) / 730 + 0.005  # with its disk and address
# How the spec's own probe names its requests.
NAME = RecordRules.of(load([ROOT / "specs/grasp-planning-recorded.yaml"])[0].application).callback


def lines(latencies, failed: int = 0) -> bytes:
    rows = [{"name": NAME, "latency_s": s, "ok": True} for s in latencies]
    rows += [{"name": NAME, "latency_s": 0.1, "ok": False, "reason": "no grasp"}] * failed
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


def test_a_deployment_that_does_what_was_predicted(paper) -> None:
    application, expected = paper
    seen = observe(lines([expected.latency.predicted] * 50), application, expected, MACHINE)
    assert (seen.requests, seen.drift, seen.violated) == (50, "none", ())
    assert seen.cost_usd_per_request == pytest.approx(PAID_USD_PER_HOUR / 3600 * expected.latency.predicted)


def test_over_the_limit_too_dear_and_failing(paper) -> None:
    application, expected = paper
    seen = observe(lines([9.0] * 50, failed=20), application, expected, MACHINE)
    assert seen.drift == "slower"
    assert seen.violated == (Limit.LATENCY, Limit.COST, Limit.SUCCESS_RATE)
    texts = [violation_text(one, seen, expected) for one in seen.violated]
    assert "over its limit of 2 s" in texts[0]
    assert texts[1] == "a cost of $1.39 per 1,000 requests is over its limit of $1.00 per 1,000 requests"
    assert "20 of 70 requests failed" in texts[2]


def test_a_change_shows_whatever_was_before_it(paper) -> None:
    application, expected = paper
    seen = observe(lines([1.65] * 9000 + [1.9] * 1000), application, expected, MACHINE)
    assert (seen.requests, seen.drift) == (1000, "slower")


@pytest.mark.parametrize("statistic", ["mean", "p50", "p95"])
def test_of_scenarios_the_value_lies_in_its_own_interval(paper, statistic) -> None:
    """A hard request of 3 s is a half of the use, and every third one: the mean is 1.6 s."""
    application, expected = paper
    benchmark = application.spec.benchmark.model_copy(update={"scenarios": {"easy": 1.0, "hard": 1.0}})
    application = application.model_copy(update={"spec": application.spec.model_copy(update={"benchmark": benchmark})})
    latency = expected.latency.model_copy(update={"statistic": statistic, "limit": 1.4, "interval": (1.5, 1.7)})
    kinds = ["hard" if n % 3 == 0 else "easy" for n in range(300)]
    rows = [
        {"name": NAME, "latency_s": (3.0 if one == "hard" else 0.2) + n % 7 / 100, "ok": True, "scenario": one}
        for n, one in enumerate(kinds)
    ]
    timings = "".join(json.dumps(row) + "\n" for row in rows).encode()
    seen = observe(timings, application, expected.model_copy(update={"latency": latency}), MACHINE)
    assert seen.value_s is not None
    assert seen.interval_s is not None
    assert seen.interval_s[0] <= seen.value_s <= seen.interval_s[1]
    if statistic == "mean":
        assert (seen.drift, Limit.LATENCY in seen.violated) == ("none", True)
    easy = [row for row in rows if row["scenario"] == "easy"]
    half = observe("".join(json.dumps(row) + "\n" for row in easy).encode(), application, expected, MACHINE)
    assert half.interval_s is None, "there were no hard ones to judge by"


def test_the_first_requests_of_a_process_do_not_count(paper) -> None:
    """Nor do those of one that was started again: a cold second is neither drift nor a broken limit."""
    application, expected = paper
    cold = [
        {"name": NAME, "latency_s": 60.0 if n % 20 == 0 else 1.65, "ok": n % 20 != 0, "process": f"{n // 20}-a"}
        for n in range(60)
    ]
    seen = observe("".join(json.dumps(row) + "\n" for row in cold).encode(), warmed(application, 1), expected, MACHINE)
    assert (seen.requests, seen.failed, seen.violated) == (57, 0, ())


def test_a_limit_inside_of_the_interval_is_unclear(paper) -> None:
    application, expected = paper
    seen = observe(lines([1.0, 2.9] * 30), application, expected, MACHINE)
    assert (seen.violated, seen.unclear) == ((), (Limit.LATENCY,))
    said = unclear_text(Limit.LATENCY, seen, expected)
    assert said.startswith("mean latency 1.95 s [")
    assert said.endswith(" against its limit of 2 s")
    cheap = expected.model_copy(update={"cost": expected.cost.model_copy(update={"limit": seen.cost_usd_per_request})})
    dear = observe(lines([1.0, 2.9] * 30), application, cheap, MACHINE)
    assert dear.unclear == (Limit.LATENCY, Limit.COST)
    assert "a cost of $" in unclear_text(Limit.COST, dear, cheap)
    assert observe(lines([1.65] * 60), application, expected, MACHINE).unclear == ()


def test_at_a_declared_rate_it_is_the_latency_at_that_rate(paper) -> None:
    """As it was predicted, whatever the rate at which requests come meanwhile: 90 ms each, of which some would wait."""
    application, expected = paper
    latency = expected.latency.model_copy(update={"predicted": 0.207, "interval": (0.18, 0.24), "limit": 0.3})
    expected = expected.model_copy(update={"latency": latency})
    rows = [
        {"name": NAME, "start_s": n / 2, "latency_s": 0.37 if n % 5 == 4 else 0.02, "ok": True} for n in range(1000)
    ]
    timings = "".join(json.dumps(row) + "\n" for row in rows).encode()
    assert observe(timings, application, expected, MACHINE).drift == "faster", "each alone"
    objective = application.spec.objective.model_copy(update={"load": Load(rate=10.0)})
    application = application.model_copy(update={"spec": application.spec.model_copy(update={"objective": objective})})
    seen = observe(timings, application, expected, MACHINE)
    exact = simulated([row["latency_s"] for row in rows], 0.0, 0.1)
    assert (seen.drift, seen.violated, seen.value_s) == ("none", (), pytest.approx(sum(exact) / len(exact)))
    tight = expected.model_copy(update={"latency": latency.model_copy(update={"limit": 0.15})})
    assert observe(timings, application, tight, MACHINE).violated == (Limit.LATENCY,)


def account(*starts_s: float, ended: int, latency_s: float = 1.65) -> bytes:
    """Requests that were started, of which the first ones ended, each line by its time."""
    rows = []
    for number, start_s in enumerate(starts_s, 1):
        own = {"process": "7-a", "number": number, "start_s": start_s}
        rows.append({"open": NAME, **own})
        if number <= ended:
            rows.append({"name": NAME, **own, "latency_s": latency_s, "ok": True})
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


def test_a_request_that_is_open_while_none_ends(paper) -> None:
    application, expected = paper
    timings = account(*(2.0 * n for n in range(60)), ended=59)
    seen = observe(timings, application, expected, MACHINE, 118.0 + 57.0)
    assert (seen.requests, seen.waited_s, seen.failed) == (59, 57.0, 1)
    assert observe(timings, application, expected, MACHINE, 118.0 + 2.0).waited_s is None, "it works on it"
    assert observe(timings, application, expected, MACHINE).waited_s is None, "the machine does not say what time it is"
    idle = account(*(2.0 * n for n in range(59)), ended=59)
    assert observe(idle, application, expected, MACHINE, 9000.0).waited_s is None, "nothing is asked"


def test_requests_that_raise_are_failed_ones_in_use_too(paper) -> None:
    application, expected = paper
    timings = account(*(2.0 * n for n in range(60)), ended=40)
    seen = observe(timings, application, expected, MACHINE, 130.0)
    assert Limit.SUCCESS_RATE in seen.violated
    assert seen.requests == 40


def test_starts_do_not_make_the_latest_requests_fewer(paper) -> None:
    application, expected = paper
    timings = account(*(2.0 * n for n in range(1500)), ended=1500)
    assert observe(timings, application, expected, MACHINE).requests == LATEST


def test_a_request_costs_what_the_choice_reckons(paper) -> None:
    application, expected = paper
    objective = application.spec.objective.model_copy(update={"transfer": 0.002 * 0.09})
    hardware = application.spec.hardware.model_copy(update={"spot": 1 / 3600, "startup": 60.0})
    spec = application.spec.model_copy(update={"objective": objective, "hardware": hardware})
    costlier = application.model_copy(update={"spec": spec})
    spot = MACHINE.model_copy(update={"spot": True})
    seen = observe(lines([1.65] * 50), costlier, expected, spot)
    restarts = 1 + 60 / 3600
    assert seen.cost_usd_per_request == pytest.approx(
        PAID_USD_PER_HOUR / 3600 * 1.65 * restarts + 0.002 * 0.09, rel=1e-3
    )


def test_nothing_seen_yet(paper) -> None:
    application, expected = paper
    seen = observe(b"", application, expected, MACHINE)
    assert (seen.requests, seen.value_s, seen.drift, seen.violated) == (0, None, "unknown", ())
    assert LEAST == 30


def test_the_limit_is_that_on_the_machine_wherever_it_stands(paper) -> None:
    _, expected = paper
    latency = expected.latency.model_copy(update={"limit": 0.2, "network_allowance": 0.12})
    assert latency.limit_on_machine == pytest.approx(0.08)
    assert latency.model_copy(update={"limit": None}).limit_on_machine is None
