"""Ctrl-C and TERM during work that is part of longer work."""

import signal
from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest
from pydantic import BaseModel, field_serializer

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


class Slow(BaseModel):
    """It is interrupted while it is written."""

    value: int = 1

    @field_serializer("value")
    def written(self, value: int) -> int:
        signal.raise_signal(signal.SIGINT)
        return value


@pytest.mark.parametrize("handling", [interruptible, finishing])
def test_what_insists_within_compiled_code_is_no_error_of_that_code(
    handling: Callable[[], AbstractContextManager[Interrupt]],
) -> None:
    """Pydantic makes an error of its own of what is raised while it calls back."""

    def insists() -> None:
        with handling() as interrupt:
            interrupt.asked = True
            Slow().model_dump()

    with pytest.raises(KeyboardInterrupt):
        insists()
    with pytest.raises(ZeroDivisionError), handling():
        raise ZeroDivisionError
