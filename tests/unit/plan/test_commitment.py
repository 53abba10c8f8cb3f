"""What a sample is paid for at most, by hand: its times, their sum, and what becomes of a machine that nobody ends."""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import Commitment, engine_settings, room_s, unattended


def machine(infra: str, price: float = 1.0) -> Machine:
    return Machine(infra=infra, instance="m", cpus=2, memory=4.0, price=price)


@pytest.mark.parametrize(
    ("measuring_s", "setup_s", "lifetime_s", "paid_s"),
    [
        (300.0, 600.0, 1200.0, 1620.0),
        (301.0, 600.0, 1260.0, 1680.0),
        (1.0, 0.0, 360.0, 780.0),
        (60.0, 0.0, 360.0, 780.0),
    ],
)
def test_times_by_hand(measuring_s: float, setup_s: float, lifetime_s: float, paid_s: float) -> None:
    each = Commitment(measuring_s=measuring_s, setup_s=setup_s)
    assert (each.lifetime_s, each.machine_s, each.paid_s) == (lifetime_s, lifetime_s + 300, paid_s)
    assert each.machine_s - 120 == each.deadline_s >= measuring_s + setup_s + 300
    assert each.usd(machine("our-rack/r1", 3.6)) == pytest.approx(paid_s / 1000)


def test_a_sample_costs_what_its_cloud_bills() -> None:
    """28 minutes: by the second, by the minute, and for each hour that begins where that is known or is not."""
    each, at = Commitment(measuring_s=301, setup_s=600), (0.0, 60.0, 3600.0, 3600.0)
    places = ("our-rack/r1", "lambda/us-east-1", "paperspace/East", "cudo/us")
    machines = [machine(infra, 3.6) for infra in places]
    paid = [one.paid_usd_per_hour for one in machines]
    assert each.paid_s == 1680
    assert [each.usd(one) / usd * 3600 for one, usd in zip(machines, paid, strict=True)] == pytest.approx(
        [math.ceil(1680 / step_s) * step_s if step_s else 1680 for step_s in at]
    )
    assert [one.price_words.partition(", and")[0] for one in machines] == [
        "$3.60/h", "$3.60/h", "$3.60/h for each hour that begins",
        "$3.60/h for each hour that begins, which is assumed,",
    ]  # fmt: skip


@given(st.integers(0, 10**5), st.integers(1, 10**5))
def test_the_room_is_the_most_that_is_paid_with_it(setup_s: int, paid_s: int) -> None:
    room = room_s(paid_s)
    if room < 1:
        assert Commitment(measuring_s=1.0, setup_s=0.0).paid_s > paid_s
        return
    assert Commitment(measuring_s=room, setup_s=0.0).paid_s <= paid_s
    assert Commitment(measuring_s=room + 1, setup_s=0.0).paid_s > paid_s
    assert Fraction(room) % 60 == 0


def test_an_engine_that_can_ends_the_machine() -> None:
    assert engine_settings(machine("slurm/lab/small"), 720.0) == {"slurm": {"sbatch_options": {"time": 17}}}
    assert engine_settings(machine("slurm/lab/small"), 721.0) == {"slurm": {"sbatch_options": {"time": 18}}}
    found = engine_settings(machine("kubernetes/context"), 720.5)
    deadline = {"pod_config": {"spec": {"activeDeadlineSeconds": 1021}}}
    assert found == {"kubernetes": {"set_pod_resource_limits": True, **deadline}}
    assert engine_settings(machine("ssh/pool"), 720.5) == {"ssh": deadline}
    assert engine_settings(machine("kubernetes/context"), None) == {"kubernetes": {"set_pod_resource_limits": True}}
    assert engine_settings(machine("slurm/lab/small"), None) is None
    assert engine_settings(machine("aws/r1"), 720.0) is None
    assert engine_settings(machine("gcp/r1"), 720.0) is None


def test_what_nobody_would_end_is_said_with_its_price() -> None:
    each = Commitment(measuring_s=300.0, setup_s=600.0)
    some = [machine("aws/r1", 2.0), machine("gcp/r1", 1.0), machine("gcp/us-east1", 3.0), machine("local", 0.0)]
    some += [machine("slurm/lab/small", 1.0), machine("azure/r1", 0.0)]
    first, second = unattended(some, each, "demo")
    assert "on gcp starts, it keeps running, at up to $3.02/h, until fogspec down demo" in first
    assert "on aws starts, it turns itself off 25 min after its boot" in second
    (both,) = unattended([machine("gcp/r1", 1.0), machine("azure/r1", 1.0)], each, "demo")
    assert "on azure, gcp starts" in both
    assert list(unattended([machine("local", 0.0), machine("slurm/lab/small")], each, "demo")) == []
