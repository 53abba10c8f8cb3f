"""One attempt: when it is overdue, when asking is given up, and what is billed."""

from pathlib import Path

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job, SampleStatus
from fogspec.bench.attempt import SILENCE_S, STOP_PATIENCE_S, Attempt
from fogspec.bench.journal import LaunchRecord
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample

MACHINE = Machine(infra="aws/us-east-1", instance="c6i.large", cpus=2, memory="4GiB", price="$3.6/h")
SAMPLE = Sample(id="one", machine=MACHINE, reason="")
DEADLINE_S = 300.0

OWNER = Owner("a repository", "default", "a")
NAME = f"{OWNER.prefix}one"


def made(same_boot: bool = True) -> Attempt:
    started = LaunchRecord(
        name=NAME, runner="sky", application="sha256:app", sample=SAMPLE, price_usd_per_hour=3.6, lifetime_s=600.0,
        at_s=100.0, boot="boot",
    )  # fmt: skip
    return Attempt(
        started=started,
        job=Job(
            name=NAME,
            owner=OWNER,
            task={},
            root=Path(),
            directory=Path(),
            machine=MACHINE,
            lifetime_s=600.0,
        ),
        since_s=100.0,
        same_boot=same_boot,
    )


def test_what_is_said_of_a_sample_that_takes_too_long():
    attempt = made()
    assert attempt.overdue(399.9, DEADLINE_S) is None
    assert attempt.overdue(400.0, DEADLINE_S).reason == "no_response"
    attempt.reached(SampleStatus(running=True, ready=False))
    assert attempt.overdue(400.0, DEADLINE_S).reason == "setup"
    attempt.reached(SampleStatus(running=True, timings=Path("kept")))
    end = attempt.overdue(400.0, DEADLINE_S)
    assert (end.running, end.reason, end.timings) == (False, None, Path("kept"))
    assert attempt.stopped("interrupted", "stopped").reason == "interrupted"


def test_silence_at_the_deadline_is_waited_out():
    attempt = made()
    attempt.reached(SampleStatus(running=True))
    attempt.unreachable(395.0)
    attempt.unreachable(399.0)
    assert attempt.overdue(395.0 + SILENCE_S - 0.1, DEADLINE_S) is None
    assert attempt.overdue(395.0 + SILENCE_S, DEADLINE_S) is not None
    attempt.reached(SampleStatus(running=True))
    assert attempt.overdue(401.0, DEADLINE_S) is not None, "it can be heard: there is nothing to wait for"


def test_asking_it_to_end_is_given_up_only_long_after_it_ended_itself():
    attempt, now_s, asked = made(), 200.0, 0
    while not attempt.not_stopped(now_s):
        now_s, asked = attempt.stop_after_s, asked + 1
    assert 100 + 600 + STOP_PATIENCE_S <= now_s <= 100 + 600 + STOP_PATIENCE_S + 30
    assert asked < 100


def test_what_is_billed():
    over = SampleStatus(running=False)
    assert made().billed_s(over, 250.0) == 150.0
    assert made().billed_s(over, 9000.0) == 600.0, "it ended itself"
    assert made(same_boot=False).billed_s(over, 130.0) == 600.0, "nobody knows how long it ran"
    assert made().billed_s(SampleStatus(running=False, billed_s=7.0), 250.0) == 7.0
