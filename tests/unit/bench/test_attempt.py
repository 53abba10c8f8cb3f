"""One attempt: when it is overdue, when asking is given up, and what is billed."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job, SampleStatus
from fogspec.bench.attempt import NO_ACCESS_PATIENCE_S, STOP_PATIENCE_S, Attempt
from fogspec.bench.journal import LaunchRecord
from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import PATIENCE_S, TEARDOWN_S
from fogspec.plan.schema import Sample

MACHINE = Machine(infra="aws/us-east-1", instance="c6i.large", cpus=2, memory="4GiB", price="$3.6/h")
SAMPLE = Sample(id="one", machine=MACHINE, reason="")
DEADLINE_S = 300.0

OWNER = Owner("a repository", "default", "a")
NAME = f"{OWNER.prefix}one"


@dataclass
class At:
    """A clock that stands still."""

    now: float
    name: str = "boot"
    unix: float = 1.7e9

    def now_s(self) -> float:
        return self.now

    def boot(self) -> str:
        return self.name

    def unix_s(self) -> float:
        return self.unix

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def made(machines: int | None = None) -> Attempt:
    started = LaunchRecord(
        name=NAME, runner="sky", application="sha256:app", sample=SAMPLE, price_usd_per_hour=3.6, lifetime_s=600.0,
        paid_s=1000.0, at_s=100.0, at_unix_s=1.7e9, boot="boot",
    )  # fmt: skip
    return Attempt(
        started=started,
        job=Job(
            name=NAME,
            owner=OWNER,
            root=Path(),
            directory=Path(),
            machine=MACHINE,
            lifetime_s=600.0,
        ),
        since_s=100.0,
        found_s=100.0,
        machines=machines,
    )


def test_what_is_said_of_a_sample_that_takes_too_long():
    attempt = made()
    assert attempt.overdue(399.9, DEADLINE_S) is None
    silent = attempt.overdue(400.0, DEADLINE_S)
    assert (silent.running, silent.reason) == (False, "no_response")
    assert silent.detail == "nothing was heard of the machine for 300 s"
    attempt.reached(SampleStatus(running=True, ready=False))
    late = attempt.overdue(400.0, DEADLINE_S)
    assert (late.reason, late.detail) == ("setup", "not ready after 300 s")
    attempt.reached(SampleStatus(running=True, timings=Path("kept")))
    end = attempt.overdue(400.0, DEADLINE_S)
    assert (end.running, end.reason, end.timings) == (False, None, Path("kept"))
    assert attempt.stopped("interrupted", "stopped").reason == "interrupted"


def test_silence_at_the_deadline_is_waited_out():
    attempt = made()
    attempt.reached(SampleStatus(running=True))
    attempt.unreachable(395.0)
    attempt.unreachable(399.0)
    assert attempt.overdue(395.0 + PATIENCE_S - 0.1, DEADLINE_S) is None
    assert attempt.overdue(395.0 + PATIENCE_S, DEADLINE_S) is not None
    attempt.reached(SampleStatus(running=True))
    assert attempt.overdue(401.0, DEADLINE_S) is not None, "it can be heard: there is nothing to wait for"


def test_asking_it_to_end_is_given_up_only_long_after_it_ended_itself():
    attempt, now_s, asked = made(), 200.0, 0
    while not attempt.not_stopped(now_s):
        now_s, asked = attempt.stop_after_s, asked + 1
    assert 100 + 1000 + STOP_PATIENCE_S <= now_s <= 100 + 1000 + STOP_PATIENCE_S + 30
    assert asked < 100


def test_without_access_asking_it_to_end_is_given_up_soon():
    attempt, now_s = made(), 200.0
    attempt.end = SampleStatus(running=False, reason="access", detail="log in first")
    assert attempt.has_no_access
    while not attempt.not_stopped(now_s):
        now_s = attempt.stop_after_s
    assert 200 + NO_ACCESS_PATIENCE_S <= now_s <= 200 + NO_ACCESS_PATIENCE_S + 30


def test_what_was_measured_while_nobody_looked_is_fetched_before_it_is_overdue():
    attempt = made()
    attempt.found_s = 5000.0
    assert attempt.overdue(5000.0 + PATIENCE_S - 1, DEADLINE_S) is None
    assert attempt.overdue(5000.0 + PATIENCE_S, DEADLINE_S) is not None


OVER = SampleStatus(running=False)


def test_what_passed_is_billed_and_no_cap():
    assert made().billed_s(OVER, At(250.0)) == 150.0
    assert made().billed_s(OVER, At(9000.0)) == 8900.0, "it was there until then"
    assert made().outlived_s(At(9000.0)) == 7900.0


def test_a_machine_that_ended_while_nobody_looked_is_billed_for_its_longest_time():
    attempt = made()
    attempt.gone_s = 9000.0
    assert attempt.billed_s(OVER, At(9007.0)) == 1000.0 + TEARDOWN_S + 7, "and until it is verified"
    assert attempt.outlived_s(At(9007.0)) == 0.0


def test_over_a_restart_the_wall_clock_tells_and_is_believed_only_upwards():
    assert made().billed_s(OVER, At(30.0, "another", 1.7e9 + 200)) == 1000.0
    assert made().billed_s(OVER, At(30.0, "another", 1.7e9 - 86400)) == 1000.0
    assert made().billed_s(OVER, At(30.0, "another", 1.7e9 + 4000)) == 4000.0


def test_that_nothing_is_paid_is_not_believed_of_a_machine_that_measured():
    free = SampleStatus(running=False, reason="capacity", billed_s=0.0)
    attempt = made()
    assert attempt.billed_s(free, At(250.0)) == 0.0
    attempt.reached(SampleStatus(running=True))
    assert attempt.billed_s(free, At(250.0)) == 150.0
    assert made().billed_s(SampleStatus(running=False, billed_s=7.0), At(250.0)) == 7.0


def test_every_machine_that_its_provider_lists_is_paid() -> None:
    """SkyPilot starts another where it does not see the first; and a refused launch may have had a machine."""
    refused = SampleStatus(running=False, reason="access", billed_s=0.0)
    assert made(machines=1).billed_s(refused, At(250.0)) == 150.0
    assert made(machines=2).billed_s(refused, At(250.0)) == 300.0
    assert made(machines=2).billed_s(OVER, At(250.0)) == 300.0
    assert made(machines=1).billed_s(OVER, At(250.0)) == 150.0


def test_what_could_not_be_had_is_free_only_where_that_is_certain() -> None:
    """A launch that fails after minutes is told in the same words, whether or not there was a machine."""
    none = SampleStatus(running=False, reason="capacity", ready=False)
    assert made().billed_s(none, At(250.0)) == 150.0
    assert made(machines=0).billed_s(none, At(250.0)) == 0.0, "its provider lists those that have ended"
    assert made(machines=0).billed_s(replace(none, reason="setup"), At(250.0)) == 150.0
    measured, resumed = made(machines=0), replace(made(machines=0), found_s=9000.0)
    measured.reached(SampleStatus(running=True))
    assert measured.billed_s(none, At(250.0)) == 150.0
    assert resumed.billed_s(none, At(9100.0)) == 9000.0, "nor for ever"


def test_no_machine_costs_less_than_its_cloud_bills_at_least() -> None:
    """AWS and Google Cloud bill a minute at least, others each hour that begins."""
    assert made().billed_s(OVER, At(105.0)) == 60.0
    assert made(machines=2).billed_s(OVER, At(105.0)) == 120.0
    free = SampleStatus(running=False, reason="capacity", billed_s=0.0)
    assert made().billed_s(free, At(105.0)) == 0.0, "there was none"
    hourly = made(machines=2)
    elsewhere = SAMPLE.model_copy(update={"machine": MACHINE.model_copy(update={"infra": "paperspace/East"})})
    hourly.started = replace(hourly.started, sample=elsewhere)
    assert hourly.billed_s(OVER, At(105.0)) == 7200.0
    assert hourly.started.commitment_usd == pytest.approx(3.6), "for a lifetime of 1,000 s"
