"""One attempt: when it is overdue, when asking is given up, and what is billed."""

from pathlib import Path

from fogspec.backends.protocol import Job, Progress
from fogspec.bench.attempt import END_PATIENCE_S, SILENCE_S, Attempt
from fogspec.bench.journal import LaunchRecord
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample

MACHINE = Machine(infra="aws/us-east-1", instance="c6i.large", cpus=2, memory="4GiB", price="$3.6/h")
SAMPLE = Sample(id="one", machine=MACHINE, reason="")
DEADLINE_S = 300.0


def made(same_boot: bool = True) -> Attempt:
    started = LaunchRecord("a", "sky", "sha256:app", SAMPLE, 3.6, 600.0, 100.0, "boot")
    return Attempt(started, Job("a", SAMPLE, {}, Path(), Path(), 600.0), since_s=100.0, same_boot=same_boot)


def test_what_is_said_of_a_sample_that_takes_too_long():
    attempt = made()
    assert attempt.overdue(399.9, DEADLINE_S) is None
    assert attempt.overdue(400.0, DEADLINE_S).reason == "no_response"
    attempt.heard(Progress(running=True, ready=False))
    assert attempt.overdue(400.0, DEADLINE_S).reason == "setup"
    attempt.heard(Progress(running=True, timings=Path("kept")))
    end = attempt.overdue(400.0, DEADLINE_S)
    assert (end.running, end.reason, end.timings) == (False, None, Path("kept"))
    assert attempt.stopped("interrupted", "stopped").reason == "interrupted"


def test_silence_at_the_deadline_is_waited_out():
    attempt = made()
    attempt.heard(Progress(running=True))
    attempt.unheard(395.0)
    attempt.unheard(399.0)
    assert attempt.overdue(395.0 + SILENCE_S - 0.1, DEADLINE_S) is None
    assert attempt.overdue(395.0 + SILENCE_S, DEADLINE_S) is not None
    attempt.heard(Progress(running=True))
    assert attempt.overdue(401.0, DEADLINE_S) is not None, "it can be heard: there is nothing to wait for"


def test_asking_it_to_end_is_given_up_only_long_after_it_ended_itself():
    attempt, now_s, asked = made(), 200.0, 0
    while not attempt.not_ended(now_s):
        now_s, asked = attempt.end_after_s, asked + 1
    assert 100 + 600 + END_PATIENCE_S <= now_s <= 100 + 600 + END_PATIENCE_S + 30
    assert asked < 100


def test_what_is_billed():
    over = Progress(running=False)
    assert made().billed_s(over, 250.0) == 150.0
    assert made().billed_s(over, 9000.0) == 600.0, "it ended itself"
    assert made(same_boot=False).billed_s(over, 130.0) == 600.0, "nobody knows how long it ran"
    assert made().billed_s(Progress(running=False, billed_s=7.0), 250.0) == 7.0
