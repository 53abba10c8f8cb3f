"""Nothing leaks, nothing is overspent, nothing is lost, whatever fails and whenever the controller is killed."""

import math

import pytest

from tests.faults import batches, campaign
from tests.faults.controllers import COMMITMENT, one_bench, samples
from tests.faults.simulation import Killed, World


def test_benches_with_faults_and_a_kill_at_every_step():
    """Other seeds than those of `make faults`, which takes a thousand."""
    tally = campaign.main(60, first=5000)
    assert tally["benches"] >= 60
    assert tally["kills"] >= 100
    assert tally["samples finished"] >= 100
    assert tally["samples without a machine"] >= 10
    assert tally["benches that lost their journal"] >= 6
    assert tally.billed_usd >= tally.true_usd
    assert tally.billed_usd < 1.6 * tally.true_usd, "and not absurdly more"
    assert {name: tally[name] for name in campaign.WRONG} == dict.fromkeys(campaign.WRONG, 0)


def test_the_campaign_would_notice_a_controller_that_forgets_to_end_its_machines(monkeypatch):
    monkeypatch.setattr(campaign.World, "faults", False)
    from tests.faults.simulation import FaultyBackend

    monkeypatch.setattr(FaultyBackend, "stop", lambda self, job: None)
    tally = campaign.Tally()
    campaign.run_one(0, tally, kills=set(), faults=False)
    assert tally["machines leaked"] == 3


def test_a_machine_that_comes_back_after_it_was_verified_gone_is_ended_and_paid(monkeypatch, tmp_path):
    """The provider says that it is gone; it is not, and its lists tell so."""
    from tests.faults.simulation import FaultyBackend

    true_stop, lied = FaultyBackend.stop, []

    def stop(self, job):
        if job.name not in lied:
            lied.append(job.name)
        else:
            true_stop(self, job)

    monkeypatch.setattr(FaultyBackend, "stop", stop)
    world, tally = World(0, tmp_path, faults=False), campaign.Tally()
    one_bench(world, 0, 10.0, samples(3), lambda _: None)
    campaign.judge(world, 10.0, tally)
    assert len(lied) == 3
    assert {name: tally[name] for name in campaign.WRONG} == dict.fromkeys(campaign.WRONG, 0)
    assert [record.reason for record in world.disk["samples"].values()] == [None] * 3


def test_a_machine_without_an_end_of_its_own_is_billed_for_all_of_its_time(tmp_path):
    """Its controller dies with the whole computer, and comes back after hours: its bill is true, and its record says why."""
    world = World(0, tmp_path, faults=False, kills={8})
    with pytest.raises(Killed):
        one_bench(world, 0, 10.0, samples(1), lambda _: None)
    (machine,) = world.machines.values()
    machine.armed = machine.limit = math.inf
    world.reboot()
    world.absent(5 * 3600)
    one_bench(world, world.controller, 10.0, samples(1), lambda _: None)
    tally = campaign.Tally()
    campaign.judge(world, 10.0, tally)
    assert {name: tally[name] for name in campaign.WRONG} == dict.fromkeys(campaign.WRONG, 0)
    assert world.bill == pytest.approx(world.disk["spent"], rel=0.01)
    assert world.bill > 0.1 * 5
    assert "did not end by itself and was paid for" in str(world.disk["samples"]["s0"].detail)


def test_a_machine_that_ended_by_itself_while_nobody_looked_is_not_billed_for_the_weekend(tmp_path):
    world = World(0, tmp_path, faults=False, kills={8})
    with pytest.raises(Killed):
        one_bench(world, 0, 10.0, samples(1), lambda _: None)
    world.absent(60 * 3600)
    one_bench(world, world.controller, 10.0, samples(1), lambda _: None)
    (one,) = samples(1)
    first, *_ = campaign.paid(world).values()
    assert COMMITMENT.usd(one.machine) <= first <= 1.2 * COMMITMENT.usd(one.machine)


def test_an_adaptive_campaign_killed_at_a_write_ends_as_if_nobody_had():
    """Every fifth write, three of them between the files of one batch; `make faults` takes them all."""
    tally = batches.main(every=5)
    assert tally["ended differently"] == 0
    assert tally["batches"] >= 3
    assert tally["samples without a machine"] >= 2
    assert tally["adaptive benches"] >= 6


def test_a_wall_that_has_come_nearer_stops_the_dearest_machines(tmp_path):
    """Four machines run, the bench is killed, and the next one may spend less than they could cost."""
    world = World(0, tmp_path, faults=False, kills={26})
    wanted = samples(4)
    with pytest.raises(Killed):
        one_bench(world, 0, 10.0, wanted, lambda _: None)
    assert sum(machine.up(world.now) for machine in world.machines.values()) == 4
    most = world.bill + sum(COMMITMENT.usd(one.machine) for one in wanted[:2])
    one_bench(world, 1, most, wanted, lambda _: None)
    records = world.disk["samples"]
    assert [records[one.id].reason for one in wanted] == [None, None, "budget", "budget"]
    assert world.bill <= most
    assert not [machine for machine in world.machines.values() if machine.ended is None]
