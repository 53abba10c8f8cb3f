"""Nothing leaks, nothing is overspent, nothing is lost, whatever fails and whenever the controller is killed."""

from tests.faults import campaign


def test_a_thousand_benches_and_a_kill_at_every_step():
    tally = campaign.main()
    assert tally["benches"] >= 1000
    assert tally["kills"] >= 500
    assert tally["samples finished"] >= 1000
    assert {name: tally[name] for name in campaign.WRONG} == dict.fromkeys(campaign.WRONG, 0)


def test_the_campaign_would_notice_a_controller_that_forgets_to_end_its_machines(monkeypatch):
    monkeypatch.setattr(campaign.World, "faults", False)
    from tests.faults.simulation import FaultyRunner

    monkeypatch.setattr(FaultyRunner, "end", lambda self, job: None)
    tally = campaign.Tally()
    campaign.run_one(0, tally, kills=set(), faults=False)
    assert tally["machines leaked"] == 3
