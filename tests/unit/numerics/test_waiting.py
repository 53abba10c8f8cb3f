"""Requests that come one a period, against a simulation request by request."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.agent.intervals import quantile
from fogspec.numerics.waiting import BUSY, Waiting, steepness, table, waits_s

times_s = st.lists(st.floats(0.001, 10.0), min_size=2, max_size=60)


def simulated(service_s: Sequence[float], between_s: float, period_s: float) -> list[float]:
    """The latency of each request, the next one coming a period later."""
    free_s, found = 0.0, []
    for number, took_s in enumerate(service_s):
        begins_s = max(free_s, number * period_s)
        found.append(begins_s + took_s - number * period_s)
        free_s = begins_s + took_s + between_s
    return found


def statistic(latencies_s: Sequence[float], shares: Sequence[float], share: float | None) -> float:
    pairs = sorted((one, own) for one, own in zip(latencies_s, shares, strict=True) if own)
    return math.fsum(one * own for one, own in pairs) if share is None else quantile(pairs, share)


@given(times_s, st.floats(0, 1), st.sampled_from([None, 0.5, 0.95]), st.data())
def test_the_table_is_what_a_simulation_gives(
    service_s: list[float], between_s: float, share: float | None, data: st.DataObject
) -> None:
    counts = data.draw(st.lists(st.booleans(), min_size=len(service_s), max_size=len(service_s)).filter(any))
    shares = np.array(counts) / sum(counts)
    found = table(np.array(service_s), between_s, shares, share)
    saturated_s = math.fsum(service_s) / len(service_s) + between_s
    alone = statistic(service_s, shares.tolist(), share) / saturated_s
    for busy, at_rate in zip(BUSY[1:].tolist(), found[1:].tolist(), strict=True):
        scaled = [busy * one / saturated_s for one in service_s]
        exact = statistic(simulated(scaled, busy * between_s / saturated_s, 1.0), shares.tolist(), share)
        assert at_rate == pytest.approx(exact / alone, rel=1e-6)
    assert (found >= BUSY * (1 - 1e-8)).all(), "no request takes less than it would alone"
    assert (np.diff(found) > 0).all()


@given(times_s, st.floats(0, 1), st.floats(0.01, 10))
def test_waits_are_those_of_a_simulation(service_s: list[float], between_s: float, period_s: float) -> None:
    found = np.array(service_s) + waits_s(np.array(service_s), between_s, period_s)
    assert found == pytest.approx(simulated(service_s, between_s, period_s), rel=1e-6, abs=1e-9)


def three() -> Waiting:
    """Machines at which nothing waits, something, and a machine of the second table that is busy at half the latency."""
    return Waiting(np.array([BUSY, BUSY * (1 + BUSY**2)]), np.array([0, 1, 1]), np.array([2.0, 2.0, 1.0]))


def test_latency_and_that_of_requests_one_after_the_other_are_inverse() -> None:
    waiting = three()
    alone_s = np.array([[0.5, 0.5, 0.5], [1.0, 1.0, 1.0], [2.0, 2.0, 3.0]])
    at_rate_s = waiting.at_rate(alone_s)
    assert at_rate_s[0] == pytest.approx([0.5, 0.5 * (1 + 1 / 16), 0.5 * 1.25], rel=1e-3)
    assert at_rate_s[2] == pytest.approx([2.0, 4.0, 6.0]), "beyond what it can do, by the last factor"
    assert waiting.alone(at_rate_s) == pytest.approx(alone_s)
    assert waiting.alone(np.array([0.0, math.inf, 2.0])).tolist() == [0.0, math.inf, 1.0]
    assert np.isnan(waiting.at_rate(np.array([math.nan] * 3))).all()


def test_some_of_the_machines() -> None:
    rows = np.array([2, 0])
    assert three().take(rows).at_rate(np.ones(2)).tolist() == three().at_rate(np.ones(3))[rows].tolist()
    grid = np.ones((2, 4))
    assert three().typical.at_rate(grid).tolist() == grid.tolist(), "between machines: the first table"


def test_how_much_steeper() -> None:
    assert steepness(BUSY, 0.5) == pytest.approx(1.0)
    assert steepness(BUSY**2, 0.6) == pytest.approx(2.0, rel=0.01)
    assert steepness(BUSY**2, 1.0) == pytest.approx(2.0, rel=0.02)
