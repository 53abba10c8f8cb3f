"""What a request costs: busy and provisioned, spot machines that are interrupted, and data that is transferred."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.catalog.cost import Costs

PRICE = np.array([3.6, 3.6])
SPOT = np.array([False, True])


def costs(
    rate_per_h: float = 0.0, restart_s: float = 0.0, transfer: float = 0.0, requests: float | None = None
) -> Costs:
    return Costs(
        price_usd_per_hour=PRICE,
        spot=SPOT,
        interruptions_per_s=rate_per_h / 3600,
        restart_s=restart_s,
        transfer_usd=transfer,
        requests_per_s=requests,
    )


def test_busy_seconds_at_the_price():
    assert costs().per_request(np.array([2.0, 2.0])) == pytest.approx([0.002, 0.002])


def test_disk_and_address_are_paid_as_long_as_the_machine():
    found = replace(costs(), beside_usd_per_hour=np.array([0.0, 1.8]))
    assert found.per_request(np.array([2.0, 2.0])) == pytest.approx([0.002, 0.003])
    assert found.latency_within(0.003) == pytest.approx([3.0, 2.0])
    assert found.take(np.array([1])).per_request(np.array([2.0])) == pytest.approx([0.003])
    assert replace(found, requests_per_s=2.0).per_request(np.array([2.0, 2.0])) == pytest.approx([0.0005, 0.00075])


def test_an_hour_is_shared_by_its_requests():
    assert costs(requests=2.0).per_request(np.array([0.1, np.nan])) == pytest.approx([0.0005, np.nan], nan_ok=True)


def test_a_session_pays_its_start_up():
    always = costs(requests=2.0)
    # Twenty minutes a week after five of start-up.
    week = 7 * 24 * 3600
    some = replace(always, used=1200 / week, up=1500 / week)
    latency = np.array([0.1, 0.1])
    assert some.per_request(latency) == pytest.approx(always.per_request(latency) * 1.25)
    limit = float(some.per_request(latency)[0])
    assert some.latency_within(limit * 1.001)[0] == np.inf
    assert some.latency_within(limit * 0.999)[0] == 0


def test_data_is_added_to_every_request():
    assert costs(transfer=0.01).per_request(np.array([2.0, 2.0])) == pytest.approx([0.012, 0.012])
    assert costs(transfer=0.01, requests=2.0).per_request(np.array([2.0, 2.0])) == pytest.approx([0.0105, 0.0105])


def test_an_interrupted_hour_starts_over():
    """One interruption an hour, ten minutes to restart, requests of an hour: (1 h + 10 min) * (e - 1)."""
    _, spot = costs(rate_per_h=1.0, restart_s=600).per_request(np.array([3600.0, 3600.0]))
    assert spot == pytest.approx(3.6 * (1 + 1 / 6) * (math.e - 1))


def test_the_formula_is_what_a_simulation_pays():
    random = np.random.default_rng(0)
    rate, restart, length, paid = 1 / 3600, 300.0, 1800.0, []
    for _ in range(20_000):
        total = 0.0
        while (lived := random.exponential(1 / rate)) < length:
            total += lived + restart
        paid.append(total + length)
    _, spot = costs(rate_per_h=1.0, restart_s=restart).per_request(np.array([length, length]))
    assert np.mean(paid) == pytest.approx(spot / 3.6 * 3600, rel=0.02)


@given(
    st.floats(1e-6, 10),
    st.just(0.0) | st.floats(1e-9, 5),
    st.floats(0, 3600),
    st.floats(0, 1e-3),
    st.sampled_from([None, 0.5]),
)
def test_a_limit_on_the_cost_is_one_on_the_latency(limit, rate, restart, transfer, requests):
    some = costs(rate, restart, transfer, requests)
    most = some.latency_within(limit)
    inside = np.isfinite(most) & (most > 0)
    assert (some.per_request(np.where(inside, most, 0.0))[inside] <= limit * (1 + 1e-9)).all()
    assert (some.per_request(np.where(inside, most * 1.001, 0.0))[inside] >= limit * (1 - 1e-9)).all()
    assert (some.per_request(np.full(2, 1e-9))[most == 0] >= limit * (1 - 1e-6)).all()


def test_spot_is_never_cheaper_than_its_price_says():
    on_demand, spot = costs(rate_per_h=0.05, restart_s=300).per_request(np.array([10.0, 10.0]))
    assert spot > on_demand
    assert spot == pytest.approx(on_demand, rel=0.01)
