"""`stop: {precision: 5%}`: where the agent stops, the statistic is that close to the truth as often as it says."""

import json
import math
import random
from pathlib import Path

import pytest

from fogspec.agent.intervals import interval
from fogspec.agent.stopping import Timings

RUNS = 200
SHARES = {"p50": 0.5, "p95": 0.95}


def stopped_at(chance: random.Random, deviation: float, resemblance: float, statistic: str) -> float:
    """The statistic when the agent would stop at 5%, of lognormal latencies each of which resembles the one before."""
    timings, noise = Timings(Path("none"), warmup=0), chance.gauss(0, 1)
    while not (timings.due() and timings.precise(0.05, statistic)):
        noise = resemblance * noise + math.sqrt(1 - resemblance**2) * chance.gauss(0, 1)
        timings.valid.append(math.exp(deviation * noise))
        assert len(timings.valid) < 20_000
    return interval(timings.valid, statistic).value


@pytest.mark.slow
@pytest.mark.parametrize("resemblance", [0.0, 0.5])
@pytest.mark.parametrize("statistic", ["mean", "p50", "p95"])
def test_it_is_as_close_as_it_says(statistic, resemblance):
    deviation, chance = 0.25, random.Random(f"{statistic} {resemblance}")
    quantile = {"mean": deviation / 2, "p50": 0.0, "p95": 1.644854}[statistic]
    truth = math.exp(deviation * quantile)
    found = [stopped_at(chance, deviation, resemblance, statistic) for _ in range(RUNS)]
    close = sum(abs(value / truth - 1) <= 0.05 for value in found) / RUNS
    # Stopping when it looks good costs a little of the 95%, correlation that lasts longer than one request some more.
    assert close >= 0.88


def test_equal_latencies_are_precise_after_ten():
    timings = Timings(Path("none"), warmup=0)
    for count in range(1, 11):
        timings.valid.append(0.5)
        assert (timings.due() and timings.precise(0.05, "mean")) == (count == 10)


@pytest.mark.slow
@pytest.mark.parametrize("statistic", ["mean", "p50", "p95"])
def test_a_latency_below_the_one_that_decides_rarely_seems_above_it(statistic):
    """At every check of 200 requests, of machines that are just as fast as that latency."""
    chance, wrong = random.Random(statistic), 0
    truth = math.exp(0.1 * {"mean": 0.05, "p50": 0.0, "p95": 1.644854}[statistic])
    for _ in range(RUNS):
        timings = Timings(Path("none"), warmup=0)
        for _ in range(200):
            timings.valid.append(math.exp(0.1 * chance.gauss(0, 1)))
            if timings.due() and timings.above(truth, statistic):
                wrong += 1
                break
    # Half of a percent at each of 30 checks, which resemble each other.
    assert wrong <= 0.1 * RUNS


def test_a_latency_that_is_far_above_is_seen_at_once():
    timings = Timings(Path("none"), warmup=0)
    for count in range(1, 11):
        timings.valid.append(0.5 + 0.01 * (count % 3))
        assert (timings.due() and timings.above(0.3, "mean")) == (count == 10)
    assert not timings.above(0.6, "mean")


@pytest.mark.parametrize("rare", [40, 5])
def test_scenarios_are_precise_once_the_rare_one_is(tmp_path: Path, rare: int) -> None:
    """A half of the use, and one in `rare` of the sample; a kind that the spec does not weigh counts for nothing."""
    chance, timings = random.Random(7), Timings(tmp_path / "t", 0, weights={"easy": 1.0, "hard": 1.0})
    with open(tmp_path / "t", "a") as file:
        for n in range(20_000):
            kind = "hard" if n % rare == rare - 1 else ("easy" if n % 3 else "other")
            latency_s = chance.uniform(0.4, 1.6) if kind == "hard" else 9.0 if kind == "other" else 0.02
            file.write(json.dumps({"latency_s": latency_s, "ok": True, "scenario": kind}) + "\n")
            file.flush()
            timings.read()
            if timings.due() and timings.precise(0.1, "mean"):
                break
    hard = timings.kinds.count("hard")
    assert 20 < hard < 100
    assert len(timings.valid) < n * 0.9
    whole = interval(timings.valid, "mean", kinds=timings.kinds, weights=timings.weights)
    assert whole.value == pytest.approx(0.51, rel=0.1)
