"""What a campaign says and keeps of machines that it cannot reach or end."""

import contextlib
from typing import get_args

import pytest

from fogspec.backends.protocol import LaunchRefused, SampleStatus, Unreachable, no_access
from fogspec.backends.skypilot.errors import CloudProblem, classify
from fogspec.base.units import dollars
from fogspec.bench.attempt import STOP_PATIENCE_S
from fogspec.bench.campaign import Campaign
from fogspec.bench.progress import FINAL
from fogspec.bench.types import Event, EventKind, Queued
from fogspec.results.schema import Reason
from tests.faults.campaign import paid
from tests.faults.controllers import COMMITMENT, campaign_of, samples
from tests.faults.simulation import FaultyBackend, VirtualClock, World


def unavailable(text: str) -> Exception:
    """What SkyPilot raises for all that fails until a machine has booted."""
    problem = type("ResourcesUnavailableError", (Exception,), {})("Failed to provision all possible resources")
    problem.failover_history = [Exception(text)]
    return problem


@pytest.fixture
def told(tmp_path):
    """A campaign in a world without faults, and all that it reports."""
    world, events = World(0, tmp_path, faults=False), list[Event]()
    campaign = campaign_of(world, 0, 10.0, lambda _: None)
    campaign.report = events.append
    campaign.journal.begin("simulated", "a", "p", 0.0)
    yield campaign, events, world
    campaign.journal.close()


def test_a_machine_that_never_goes_is_given_up_and_stays_in_the_books(told, monkeypatch):
    campaign, events, world = told
    asked = []

    def stop(self, job):
        asked.append(job.name)
        assert len(asked) < 1000, "it is asked for ever"
        raise Unreachable("the cloud does not answer")

    monkeypatch.setattr(FaultyBackend, "stop", stop)
    campaign.run(samples(2))
    names = sorted(set(asked))
    assert len(names) == 2
    assert sorted(campaign.left) == names, "each is named, once"
    assert campaign.running == {}
    assert campaign.denied is None, "there is access: the next samples are measured"
    assert sorted(campaign.journal.state.open) == names
    most = sum(one.machine.price for one in samples(2)) * COMMITMENT.paid_s / 3600
    assert campaign.journal.state.committed_usd == pytest.approx(most), "its bill stays committed"
    ends = [one for one in events if one.kind is EventKind.ENDS]
    assert ends[0].detail is None, "clouds take a while"
    assert ends[-1].detail == "the cloud does not answer"
    assert world.now > COMMITMENT.paid_s, "not before it must have ended itself"


def test_on_a_cloud_that_was_not_tried_the_cheapest_machine_starts_alone(told):
    """Until its nodes are ready; of another cloud it says nothing."""
    campaign, events, _ = told
    campaign.proven.clear()
    others = [one.model_copy(update={"id": f"o-{one.id}", "machine": one.machine.model_copy(update={"infra": "other"})})
              for one in samples(2)]  # fmt: skip
    campaign.run([*reversed(samples(3)), *others])
    said = [(one.kind, one.sample.id) for one in events]
    starts = [said.index((EventKind.STARTS, name)) for name in ("s0", "s1", "s2")]
    assert (
        max(starts[0], said.index((EventKind.STARTS, "o-s0")))
        < said.index((EventKind.MEASURES, "s0"))
        < min(starts[1:])
    )
    assert said.index((EventKind.MEASURES, "o-s0")) < said.index((EventKind.STARTS, "o-s1"))
    assert campaign.proven == {"sim", "other"}
    assert {name for kind, name in said if kind is EventKind.DONE} == {"s0", "s1", "s2", "o-s0", "o-s1"}


@pytest.mark.parametrize("again", [False, True])
def test_where_each_set_up_fails_two_machines_are_paid(told, monkeypatch, again):
    """Of 24, where all were started, or 72 of those that are worth another try."""
    campaign, events, world = told
    campaign.proven.clear()
    poll = FaultyBackend.poll

    def failed(self, job):
        found = poll(self, job)
        if world.now < world.machines[job.name].started + 240:
            return SampleStatus(running=True, ready=False)
        return (
            SampleStatus(running=False, reason="setup", detail="apt-get ended with 100", again=again)
            if found
            else found
        )

    monkeypatch.setattr(FaultyBackend, "poll", failed)
    campaign.run(samples(24))
    assert [one.sample.id for one in events if one.kind is EventKind.STARTS] == (
        ["s0", "s0"] if again else ["s0", "s1"]
    )
    assert campaign.is_halted()
    bill_usd = sum(one.bill(world.now) for one in world.machines.values())
    assert bill_usd <= campaign.journal.state.spent_usd < 3 * 0.2 * 300 / 3600


SAID = [
    *(CloudProblem(reason, "") for reason in get_args(Reason)),
    *(classify(unavailable(text)) for text in (
        "Failed to acquire resources in all zones in us-central1", "me@203.0.113.7: Permission denied (publickey).",
        "Disk quota exceeded", "401 Unauthorized", "ExpiredToken: The security token is expired", "VcpuLimitExceeded",
        "ZONE_RESOURCE_POOL_EXHAUSTED", "timed out waiting for instances to provision",
    )),
]  # fmt: skip


@pytest.mark.parametrize(("seed", "again"), [(0, True), (2, False)], ids=["says-nothing", "lists-what-ended"])
@pytest.mark.parametrize("said", SAID, ids=lambda said: f"{said.reason}-{said.detail[-20:]}")
def test_what_is_spent_is_never_less_than_the_bill_whatever_is_said(told, monkeypatch, said, seed, again):
    """Each machine is up for a minute, and given up in words that are also said where none was there."""
    campaign, _, world = told
    world.seed = seed
    end = SampleStatus(running=False, reason=said.reason, again=again, billed_s=0.0 if said.refused else None)

    def given_up(self, job):
        ready = world.now >= world.machines[job.name].started + 60
        return end if ready else SampleStatus(running=True, ready=False)

    monkeypatch.setattr(FaultyBackend, "poll", given_up)
    campaign.run(samples(3))
    bills = {name: one.bill(world.now) for name, one in world.machines.items()}
    assert len(bills) >= 2
    for name, spent_usd in paid(world).items():
        assert spent_usd >= bills[name] * (1 - 1e-9) > 0
    assert campaign.journal.state.spent_usd >= sum(bills.values()) * (1 - 1e-9)


def with_quota(monkeypatch, world, cpus):
    """Machines that would have more vCPUs together are refused, after a while; returns their names."""
    start, poll, refused = FaultyBackend.start, FaultyBackend.poll, set()

    def size(name):
        return 2 ** int(world.machines[name].sample[1:])

    def started(self, job):
        start(self, job)
        up = sum(size(name) for name, one in world.machines.items() if one.ended is None and name not in refused)
        if up > cpus:
            refused.add(job.name)
            world.machines[job.name].ended = world.now

    def polled(self, job):
        if job.name in refused:
            return SampleStatus(running=False, reason="quota", detail="VcpuLimitExceeded", ready=False, billed_s=0.0)
        return poll(self, job)

    monkeypatch.setattr(FaultyBackend, "start", started)
    monkeypatch.setattr(FaultyBackend, "poll", polled)
    return refused


def test_machines_that_use_up_the_quota_together_are_measured_one_after_the_other(told, monkeypatch):
    """1, 2, 4, 8 and 16 vCPUs, where 16 are allowed at once: all would fit, and half of them were failed for good."""
    campaign, events, world = told
    refused = with_quota(monkeypatch, world, 16)
    campaign.run(samples(5))
    assert {one.id: one.state for one in world.disk["samples"].values()} == {f"s{n}": "ok" for n in range(5)}
    assert 1 <= len(refused) <= 4, "one of its own has to end before it is asked again"
    assert EventKind.RETRIED in [one.kind for one in events]
    assert all(one.ended is not None for one in world.machines.values())


def test_a_machine_that_is_beyond_the_quota_alone_fails_and_the_others_are_measured(told, monkeypatch):
    campaign, _, world = told
    with_quota(monkeypatch, world, 8)
    campaign.run(samples(5))
    found = {one.id: (one.state, one.reason) for one in world.disk["samples"].values()}
    assert found == {f"s{n}": ("ok", None) for n in range(4)} | {"s4": ("failed", "quota")}


def test_a_machine_that_the_cloud_does_not_have_makes_way_for_the_next(told, monkeypatch):
    campaign, _, world = told
    campaign.proven.clear()
    start = FaultyBackend.start

    def refused(self, job):
        if job.machine.instance == "m0":
            raise LaunchRefused("capacity", "none left")
        start(self, job)

    monkeypatch.setattr(FaultyBackend, "start", refused)
    campaign.run(samples(2))
    assert {one.id: one.state for one in world.disk["samples"].values()} == {"s0": "failed", "s1": "ok"}


@pytest.mark.parametrize("fault", [False, True])
def test_a_cloud_that_takes_minutes_to_say_nothing_is_given_up_as_well(told, monkeypatch, fault):
    campaign, _, world = told
    asked = []

    def stop(self, job):
        asked.append(world.now)
        assert len(asked) < 1000, "it is asked for ever"
        world.now += 240
        raise Unreachable("the cloud does not answer")

    def poll(self, job):
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(FaultyBackend, "stop", stop)
    if fault:
        monkeypatch.setattr(FaultyBackend, "poll", poll)
    with pytest.raises(RuntimeError, match="a fault of ours") if fault else contextlib.nullcontext():
        campaign.run(samples(1))
    assert len(campaign.left) == 1
    assert asked[-1] - asked[0] <= STOP_PATIENCE_S + COMMITMENT.paid_s + 600


def test_while_its_computer_sleeps_nobody_tries_to_end_a_machine_and_no_patience_is_lost(told, monkeypatch):
    campaign, _, world = told
    asked, before, sleep = [], FaultyBackend.stop, VirtualClock.sleep

    def stop(self, job):
        asked.append(world.now)
        if len(asked) <= 3:
            raise Unreachable("its machine is being taken down")
        before(self, job)

    def asleep(self, seconds):
        sleep(self, seconds)
        if len(asked) == 2:
            world.absent(2 * STOP_PATIENCE_S + COMMITMENT.paid_s)

    monkeypatch.setattr(FaultyBackend, "stop", stop)
    monkeypatch.setattr(VirtualClock, "sleep", asleep)
    campaign.run(samples(1))
    assert campaign.left == []
    assert len(asked) == 4


def test_what_is_reported_of_a_sample(told, monkeypatch):
    campaign, events, world = told
    poll, lost, begun_s = FaultyBackend.poll, [], world.now

    def once_lost(self, job):
        if not lost:
            lost.append(job.name)
            raise Unreachable("no route to host")
        return poll(self, job)

    monkeypatch.setattr(FaultyBackend, "poll", once_lost)
    campaign.run(samples(1))
    assert events[0].kind is EventKind.STARTS
    assert events[0].ends_s == begun_s + COMMITMENT.deadline_s
    (silence,) = [one for one in events if one.kind is EventKind.LOST_CONTACT]
    assert silence.detail == "no route to host"
    seen = [one for one in events if one.kind in (EventKind.MEASURES, EventKind.SETS_UP)]
    assert seen
    assert all(one.status is not None and one.status.running for one in seen)
    assert {one.status.ready for one in seen if one.kind is EventKind.MEASURES} <= {True}
    assert events[-1].kind is EventKind.DONE
    assert events[-1].record is not None
    assert events[-1].spent_usd > 0
    assert all(one.sample.id == "s0" and one.folder is not None for one in events)
    assert all(one.committed_usd > 0 for one in events[:-1])
    assert events[-1].committed_usd == 0


def test_samples_that_do_not_fit_are_recorded_with_what_they_would_cost(told):
    campaign, _, world = told
    each = [one.machine.price * COMMITMENT.paid_s / 3600 for one in samples(3)]
    object.__setattr__(campaign.config, "budget_usd", each[0] * 1.01)
    campaign.run(samples(3))
    kept = world.disk["samples"]
    assert [kept[name].reason for name in ("s0", "s1", "s2")] == [None, "budget", "budget"]
    assert f"would commit {dollars(each[1])}," in kept["s1"].detail
    assert world.disk["spent"] <= each[0]
    assert len(world.machines) == 1


def test_machines_that_outlive_their_bill_leave_less_for_the_others(told, monkeypatch):
    campaign, _, _ = told
    campaign.queue += [Queued(one) for one in samples(2)]
    campaign._start_what_fits()
    each = [one.machine.price * COMMITMENT.paid_s / 3600 for one in samples(2)]
    assert campaign.journal.state.committed_usd == pytest.approx(sum(each))
    monkeypatch.setattr(Campaign, "_outlived_usd", lambda self: 0.2 * each[0])
    for over, ended in ((0.3, []), (0.2, []), (0.1, ["s1"])):
        object.__setattr__(campaign.config, "budget_usd", sum(each) + over * each[0])
        campaign._stop_what_does_not_fit()
        stopped = [one.started.sample.id for one in campaign.running.values() if one.end is not None]
        assert stopped == ended, over
    (end,) = [one.end for one in campaign.running.values() if one.end is not None]
    assert (end.running, end.reason) == (False, "budget")


def test_after_a_fault_every_machine_is_asked_to_end_until_it_is_gone_and_not_without_pause(told, monkeypatch):
    campaign, events, world = told
    asked, before = [], FaultyBackend.stop

    def stop(self, job):
        asked.append(world.now)
        if len(asked) <= 6:
            raise Unreachable("not now")
        before(self, job)

    def fault(self, job):
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(FaultyBackend, "stop", stop)
    monkeypatch.setattr(FaultyBackend, "poll", fault)
    with pytest.raises(RuntimeError, match="a fault of ours"):
        campaign.run(samples(2))
    assert campaign.left == []
    assert all(one.ended is not None for one in world.machines.values())
    assert asked[-1] - asked[0] >= 3 * campaign.backend.poll_s
    assert not [one for one in events if one.kind is EventKind.NOT_ENDED]


def test_a_sample_without_a_task_starts_nothing(told):
    campaign, _, world = told
    object.__setattr__(campaign.config, "task", lambda _sample: None)
    with pytest.raises(LookupError, match="s0 has no task"):
        campaign.run(samples(1))
    assert (world.machines, campaign.journal.state.open) == ({}, {})


def test_who_wants_to_stop_starts_no_machine(told):
    campaign, _, world = told
    campaign.stopping = lambda: True
    campaign.run(samples(2))
    assert world.machines == {}


def test_ctrl_c_twice_leaves_at_once_and_asks_nothing_more(told, monkeypatch):
    campaign, _, _ = told

    def interrupted(self, job):
        raise KeyboardInterrupt

    def never(self, job):
        raise AssertionError("the journal has what runs; down ends it")

    monkeypatch.setattr(FaultyBackend, "poll", interrupted)
    monkeypatch.setattr(FaultyBackend, "stop", never)
    with pytest.raises(KeyboardInterrupt):
        campaign.run(samples(2))
    assert len(campaign.journal.state.open) == 2


def test_machines_that_no_fault_of_ours_ends_are_named(told, monkeypatch):
    campaign, events, world = told

    def stop(self, job):
        raise Unreachable("the cloud does not answer")

    def fault(self, job):
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(FaultyBackend, "stop", stop)
    monkeypatch.setattr(FaultyBackend, "poll", fault)
    with pytest.raises(RuntimeError, match="a fault of ours"):
        campaign.run(samples(2))
    assert sorted(campaign.left) == sorted(world.machines)
    assert {one.detail for one in events if one.kind is EventKind.NOT_ENDED} == {"the cloud does not answer"}


def test_a_launch_whose_answer_is_lost_is_reported_and_watched(told, monkeypatch):
    campaign, events, _ = told
    start = FaultyBackend.start

    def started(self, job):
        start(self, job)
        raise Unreachable("no answer to the launch")

    monkeypatch.setattr(FaultyBackend, "start", started)
    campaign.run(samples(1))
    (lost,) = [one for one in events if one.kind is EventKind.LOST_CONTACT]
    assert lost.detail == "no answer to the launch"
    assert events[-1].record.state == "ok"


def test_the_longer_bill_of_a_machine_that_outlived_it_is_by_the_hour(told):
    campaign, _, world = told
    campaign.queue += [Queued(samples(1)[0])]
    campaign._start_what_fits()
    (attempt,) = campaign.running.values()
    world.now += attempt.started.paid_s + 1800
    assert campaign._outlived_usd() == pytest.approx(samples(1)[0].machine.price / 2, rel=1e-9)


def test_what_was_just_found_is_fetched_before_a_lower_budget_ends_it(told):
    campaign, _, world = told
    campaign.queue += [Queued(samples(1)[0])]
    campaign._start_what_fits()
    (attempt,) = campaign.running.values()
    object.__setattr__(campaign.config, "budget_usd", 0.0)
    world.now += 60
    attempt.found_s = world.now
    campaign._stop_what_does_not_fit()
    assert attempt.end is None
    world.now += 3600
    campaign._stop_what_does_not_fit()
    assert attempt.end is not None


def test_only_after_an_absence_is_a_machine_as_if_just_found(told):
    campaign, _, world = told
    campaign.queue += [Queued(samples(1)[0])]
    campaign._start_what_fits()
    (attempt,) = campaign.running.values()
    campaign._notice_absence()
    for pause_s in (10.0, 20.0):
        world.now += pause_s
        campaign._notice_absence()
        assert attempt.found_s == attempt.since_s, "it was watched all the time"
    world.now += 7200
    campaign._notice_absence()
    assert attempt.found_s == world.now


def test_a_machine_of_another_spec_is_ended_and_paid_and_is_no_sample(told):
    campaign, events, world = told
    campaign.queue += [Queued(samples(1)[0])]
    campaign._start_what_fits()
    (name,) = campaign.running
    campaign.running.clear()
    object.__setattr__(campaign.config, "measured", "another")
    attempt = campaign._adopted(campaign.journal.state.open[name])
    assert (attempt.end.running, attempt.end.lost) == (False, True)
    campaign.running[name] = attempt
    world.now += 100
    campaign.run([])
    assert campaign.journal.state.open == {}
    assert campaign.journal.state.spent_usd > 0
    assert world.disk.get("samples", {}) == {}
    assert events[-1].kind is EventKind.UNWANTED


def test_what_is_tried_again_is_reported_so(told, monkeypatch):
    campaign, events, _ = told
    poll, lost = FaultyBackend.poll, []

    def once_preempted(self, job):
        if not lost:
            lost.append(job.name)
            return SampleStatus(running=False, lost=True, detail="preempted")
        return poll(self, job)

    monkeypatch.setattr(FaultyBackend, "poll", once_preempted)
    campaign.run(samples(1))
    ends = [(one.kind, one.detail) for one in events if one.kind in FINAL]
    assert ends[0] == (EventKind.RETRIED, "preempted")
    assert [kind for kind, _ in ends] == [EventKind.RETRIED, EventKind.DONE]


def test_where_no_machine_can_be_had_only_one_is_asked_for_and_nothing_is_recorded(told, monkeypatch):
    campaign, events, world = told
    asked = []

    def start(self, job):
        asked.append(job.name)
        raise LaunchRefused("access", "log in first")

    monkeypatch.setattr(FaultyBackend, "start", start)
    monkeypatch.setattr(campaign.backend, "at_once", 1)
    campaign.run(samples(3))
    assert len(asked) == 1
    assert campaign.denied == "log in first"
    assert world.disk.get("samples", {}) == {}
    assert not [one for one in events if one.kind in FINAL]


def test_once_access_is_lost_nothing_is_started_again(told, monkeypatch):
    campaign, _, world = told
    asked, before = [], FaultyBackend.start

    def start(self, job):
        asked.append(job.name)
        before(self, job)

    def poll(self, job):
        if len(asked) < 3:
            return SampleStatus(running=True, ready=False)
        if job.name == asked[0]:
            return SampleStatus(running=False, reason="access", detail="ExpiredToken", billed_s=0.0)
        return SampleStatus(running=False, reason="capacity", again=job.name == asked[1], detail="none", billed_s=0.0)

    monkeypatch.setattr(FaultyBackend, "start", start)
    monkeypatch.setattr(FaultyBackend, "poll", poll)
    campaign.run(samples(3))
    assert campaign.denied == "ExpiredToken"
    assert len(asked) == 3
    assert set(world.disk["samples"]) == {samples(3)[2].id}, "what a retry may still help has no record"


def test_what_a_machine_cost_until_access_was_lost_is_booked(told, monkeypatch):
    campaign, _, world = told
    before = FaultyBackend.stop

    def poll(self, job):
        world.now += 60
        return SampleStatus(running=False, reason="access", detail="ExpiredToken", billed_s=0.0)

    def stop(self, job):
        before(self, job)
        return 1

    monkeypatch.setattr(FaultyBackend, "poll", poll)
    monkeypatch.setattr(FaultyBackend, "stop", stop)
    campaign.run(samples(2))
    assert campaign.denied == "ExpiredToken"
    assert campaign.denied_usd > 0
    assert campaign.denied_usd == pytest.approx(campaign.journal.state.spent_usd, rel=1e-6)
    assert "its machine cost $" in no_access(campaign.denied, booked_usd=campaign.denied_usd).hints[0]
    assert "nothing was started" in no_access(campaign.denied).hints[0]


def test_without_access_to_verify_a_machine_gone_it_is_named_soon_and_measured_once_there_is(told, monkeypatch):
    campaign, _, world = told
    poll, stop, refused = FaultyBackend.poll, FaultyBackend.stop, []

    def expired(self, job):
        if not refused:
            refused.append(job.name)
        return SampleStatus(running=False, reason="access", detail="ExpiredToken", billed_s=0.0)

    def cannot(self, job):
        raise Unreachable("ExpiredToken")

    monkeypatch.setattr(FaultyBackend, "poll", expired)
    monkeypatch.setattr(FaultyBackend, "stop", cannot)
    begun_s = world.now
    campaign.run(samples(1))
    assert campaign.denied == "ExpiredToken"
    assert campaign.left == refused == list(campaign.journal.state.open)
    assert world.now - begun_s < COMMITMENT.paid_s, "its user has to log in, however long it waits"
    assert "cannot be verified" in no_access(campaign.denied, verified=False).hints[0]
    campaign.journal.close()

    # What the first launch ended with is still on disk.
    monkeypatch.setattr(FaultyBackend, "poll", lambda self, job: (expired if job.name in refused else poll)(self, job))
    monkeypatch.setattr(FaultyBackend, "stop", stop)
    again = campaign_of(world, 0, 10.0, lambda _: None)
    again.recover()
    again.run([])
    again.journal.close()
    assert again.denied is None
    assert again.left == []
    assert {name: one.state for name, one in world.disk["samples"].items()} == {"s0": "ok"}
