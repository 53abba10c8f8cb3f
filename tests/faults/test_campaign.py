"""Nothing leaks, nothing is overspent, nothing is lost, whatever fails and whenever the controller is killed."""

import pytest

from tests.faults import batches, campaign
from tests.faults.controllers import one_bench, samples
from tests.faults.simulation import Killed, World


def test_a_thousand_benches_and_a_kill_at_every_step():
    tally = campaign.main()
    assert tally["benches"] >= 1000
    assert tally["kills"] >= 500
    assert tally["samples finished"] >= 1000
    assert tally["machines in another's place"] >= 100
    assert tally["benches that lost their journal"] >= 100
    assert {name: tally[name] for name in campaign.WRONG} == dict.fromkeys(campaign.WRONG, 0)


def test_the_campaign_would_notice_a_controller_that_forgets_to_end_its_machines(monkeypatch):
    monkeypatch.setattr(campaign.World, "faults", False)
    from tests.faults.simulation import FaultyBackend

    monkeypatch.setattr(FaultyBackend, "stop", lambda self, job: None)
    tally = campaign.Tally()
    campaign.run_one(0, tally, kills=set(), faults=False)
    assert tally["machines leaked"] == 3


def test_an_adaptive_campaign_killed_at_a_write_ends_as_if_nobody_had():
    """Every ninth write; `make faults` takes them all."""
    tally = batches.main(every=9)
    assert tally["ended differently"] == 0
    assert tally["batches"] >= 3
    assert tally["machines in another's place"] >= 2
    assert tally["adaptive benches"] >= 6


def test_a_wall_that_has_come_nearer_stops_the_dearest_machines(tmp_path):
    """Four machines run, the bench is killed, and the next one may spend less than they could cost."""
    world = World(0, tmp_path, faults=False, kills={26})
    wanted = samples(4)
    with pytest.raises(Killed):
        one_bench(world, 0, 10.0, wanted, lambda _: None)
    assert sum(machine.up(world.now) for machine in world.machines.values()) == 4
    most = world.bill + 0.1 * 540 / 3600 + 0.2 * 540 / 3600
    one_bench(world, 1, most, wanted, lambda _: None)
    records = world.disk["samples"]
    assert [records[one.id].reason for one in wanted] == [None, None, "budget", "budget"]
    assert world.bill <= most
    assert not [machine for machine in world.machines.values() if machine.ended is None]
