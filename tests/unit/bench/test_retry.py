"""What is tried again, what gives its place to another, and what is over a budget."""

from fogspec.backends.protocol import Progress
from fogspec.bench.retry import BACKOFF_S, TRIES, RetryPolicy, overdrawn
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample


def sample(name: str, infra: str) -> Sample:
    machine = Machine(infra=infra, instance=name, cpus=2, memory=4.0, price=0.1)
    return Sample(id=name, machine=machine, reason="")


HERE, ZONE = sample("here", "aws/r1/a"), sample("zone", "aws/r1/b")
OTHERS = [ZONE, sample("elsewhere", "aws/r2"), sample("neighbour", "aws/r1")]


def test_only_what_may_help_is_tried_again_and_not_for_ever():
    tries = RetryPolicy()
    hopeless = [Progress(running=False, reason=reason) for reason in ("quota", "capacity", "image", "crash", "setup")]
    tries.started("here")
    assert [tries.pause_s("here", end) for end in hopeless] == [None] * 5
    again = Progress(running=False, reason="capacity", again=True)
    pauses = [tries.pause_s("here", again)]
    for _ in range(TRIES):
        tries.started("here")
        pauses.append(tries.pause_s("here", again))
    assert pauses == [*BACKOFF_S, None, None]
    tries = RetryPolicy({"here": 1})
    assert tries.pause_s("here", Progress(running=False, lost=True)) == BACKOFF_S[0]


def test_capacity_goes_to_the_next_place_and_quota_to_another_region():
    tries = RetryPolicy({"here": 1})
    assert tries.instead(HERE, "capacity", OTHERS).id == "zone"
    assert tries.instead(HERE, "quota", OTHERS).id == "elsewhere"
    tries.started("zone")
    tries.started("elsewhere")
    assert tries.instead(HERE, "capacity", OTHERS).id == "neighbour"
    assert tries.instead(HERE, "quota", OTHERS) is None


def test_a_machine_that_failed_by_itself_keeps_its_place():
    for reason in (None, "crash", "out_of_memory", "image", "setup", "no_response", "check", "interrupted", "budget"):
        assert RetryPolicy({"here": 1}).instead(HERE, reason, OTHERS) is None


def test_the_last_digit_of_a_float_is_no_money():
    assert not overdrawn(0.1 + 0.2, 0.3)
    assert not overdrawn(0.0, 0.0)
    assert overdrawn(0.3001, 0.3)
