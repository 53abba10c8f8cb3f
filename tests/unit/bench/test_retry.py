"""What is tried again, what gives its place to another, and what is over a budget."""

from fogspec.backends.protocol import SampleStatus
from fogspec.bench.retry import ATTEMPTS, BACKOFF_S, RetryPolicy, overdrawn
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample


def sample(name: str, infra: str) -> Sample:
    machine = Machine(infra=infra, instance=name, cpus=2, memory=4.0, price=0.1)
    return Sample(id=name, machine=machine, reason="")


HERE, ZONE = sample("here", "aws/r1/a"), sample("zone", "aws/r1/b")
OTHERS = [ZONE, sample("elsewhere", "aws/r2"), sample("neighbour", "aws/r1")]


def test_only_what_may_help_is_tried_again_and_not_for_ever():
    retry = RetryPolicy()
    hopeless = [
        SampleStatus(running=False, reason=reason) for reason in ("quota", "capacity", "image", "crash", "setup")
    ]
    retry.started("here")
    assert [retry.pause_s("here", end) for end in hopeless] == [None] * 5
    again = SampleStatus(running=False, reason="capacity", again=True)
    pauses = [retry.pause_s("here", again)]
    for _ in range(ATTEMPTS):
        retry.started("here")
        pauses.append(retry.pause_s("here", again))
    assert pauses == [*BACKOFF_S, None, None]
    retry = RetryPolicy({"here": 1})
    assert retry.pause_s("here", SampleStatus(running=False, lost=True)) == BACKOFF_S[0]


def test_capacity_goes_to_the_next_place_and_quota_to_another_region():
    retry = RetryPolicy({"here": 1})
    assert retry.substitute(HERE, "capacity", OTHERS).id == "zone"
    assert retry.substitute(HERE, "quota", OTHERS).id == "elsewhere"
    retry.started("zone")
    retry.started("elsewhere")
    assert retry.substitute(HERE, "capacity", OTHERS).id == "neighbour"
    assert retry.substitute(HERE, "quota", OTHERS) is None


def test_a_machine_that_failed_by_itself_keeps_its_place():
    for reason in (None, "crash", "out_of_memory", "image", "setup", "no_response", "check", "interrupted", "budget"):
        assert RetryPolicy({"here": 1}).substitute(HERE, reason, OTHERS) is None


def test_the_last_digit_of_a_float_is_no_money():
    assert not overdrawn(0.1 + 0.2, 0.3)
    assert not overdrawn(0.0, 0.0)
    assert overdrawn(0.3001, 0.3)
