"""What is tried again, and what is over a budget."""

from fogspec.backends.protocol import SampleStatus
from fogspec.bench.retry import ATTEMPTS, BACKOFF_S, RetryPolicy, overdrawn


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


def test_the_last_digit_of_a_float_is_no_money():
    assert not overdrawn(0.1 + 0.2, 0.3)
    assert not overdrawn(0.0, 0.0)
    assert overdrawn(0.3001, 0.3)
