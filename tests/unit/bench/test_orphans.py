"""Machines that no journal here knows."""

import pytest

from fogspec.backends.protocol import Unreachable
from fogspec.base.errors import Busy, CloudError
from fogspec.bench.orphans import adopt_orphans
from tests.faults.controllers import campaign_of, samples
from tests.faults.simulation import FaultyBackend, World


@pytest.fixture
def campaign(tmp_path):
    world = World(0, tmp_path, faults=False)
    made = campaign_of(world, 0, 10.0, lambda _: None)
    yield made
    made.journal.close()


def lost(*_: object) -> list[str]:
    raise Unreachable("no route to host")


def named(campaign, sample: str) -> str:
    return f"{campaign.config.owner.prefix}{sample}-0123abcd-1"


def test_the_dearest_machine_that_a_name_may_mean_is_charged_for_all_of_its_life(campaign, monkeypatch):
    wanted = samples(3)
    names = [named(campaign, "s1"), f"{campaign.config.owner.prefix}unknown-1", "somebody-elses"]
    monkeypatch.setattr(FaultyBackend, "list", lambda *_: names)
    campaign.journal.begin("simulated", "a", "p", 0.0)
    adopt_orphans(campaign, wanted, resume=True)
    opened = campaign.journal.state.open
    assert list(opened) == names[:2]
    assert [one.price_usd_per_hour for one in opened.values()] == [0.2, 0.3]
    assert campaign.recover() == set()
    campaign.run([])
    life_h = campaign.config.commitment.paid_s / 3600
    assert campaign.journal.state.spent_usd == pytest.approx(0.5 * life_h)
    assert campaign.journal.state.open == {}


def test_disk_and_address_are_part_of_each_bill(campaign):
    (one,) = samples(1)
    known = one.model_copy(update={"machine": one.machine.model_copy(update={"infra": "aws/us-east-1"})})
    assert campaign.price(known) == pytest.approx(campaign.price(one) + 16.46 / 730 + 0.005)


@pytest.mark.parametrize("benches", [1, 2])
def test_they_are_left_alone_unless_that_is_asked_for(campaign, monkeypatch, benches):
    """Also by a folder that has measured before: another clone of the repository may measure now."""
    monkeypatch.setattr(FaultyBackend, "list", lambda *_: [named(campaign, "s1")])
    for _ in range(benches):
        campaign.journal.begin("simulated", "a", "p", 0.0)
    with pytest.raises(Busy, match="another bench"):
        adopt_orphans(campaign, samples(3), resume=False)
    assert campaign.journal.state.open == {}


def test_a_bench_that_starts_nothing_believes_its_journal(campaign, monkeypatch):
    monkeypatch.setattr(FaultyBackend, "list", lost)
    for _ in range(2):
        campaign.journal.begin("simulated", "a", "p", 0.0)
    adopt_orphans(campaign, samples(3), resume=False, starts=False)


def test_who_cannot_be_asked_stops_the_bench_before_it_spends(campaign, monkeypatch):
    monkeypatch.setattr(FaultyBackend, "list", lost)
    campaign.journal.begin("simulated", "a", "p", 0.0)
    with pytest.raises(CloudError, match="no route to host"):
        adopt_orphans(campaign, samples(3), resume=True)


def test_a_bench_that_is_to_resume_looks_also_where_nothing_is_left_to_start(campaign, monkeypatch):
    name = named(campaign, "s1")
    monkeypatch.setattr(FaultyBackend, "list", lambda *_: [name])
    for _ in range(2):
        campaign.journal.begin("simulated", "a", "p", 0.0)
    adopt_orphans(campaign, samples(3), resume=True, starts=False)
    assert list(campaign.journal.state.open) == [name]
