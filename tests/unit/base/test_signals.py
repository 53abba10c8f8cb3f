"""Ctrl-C and TERM during work that is part of longer work."""

import signal
from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from fogspec.base.signals import Interrupt, finishing, interruptible


@pytest.mark.parametrize(("inner", "number"), [(interruptible, signal.SIGINT), (finishing, signal.SIGTERM)])
def test_a_signal_in_the_last_moment_of_a_part_ends_the_whole(
    inner: Callable[[], AbstractContextManager[Interrupt]], number: signal.Signals
) -> None:
    """A restart that has just ended is part of a watch, which would otherwise go on."""
    with interruptible() as whole:
        with inner() as part:
            signal.raise_signal(number)
            assert part.asked
        assert whole.asked
    with interruptible() as later:
        assert not later.asked
