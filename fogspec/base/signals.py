"""Ctrl-C: the first asks for a clean stop, the second insists."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any


@dataclass(slots=True)
class Interrupt:
    """Whether the user asked to stop: the first Ctrl-C stops cleanly, the second at once."""

    asked: bool = False
    answering: bool = False

    def __call__(self, number: int, _frame: Any) -> None:
        """Handle the signal."""
        if self.asked or self.answering:
            raise KeyboardInterrupt
        self.asked = True

    @contextmanager
    def question(self) -> Iterator[None]:
        """Treat the first Ctrl-C during a prompt as its answer."""
        self.answering = True
        try:
            yield
        finally:
            self.answering = False


@contextmanager
def interruptible() -> Iterator[Interrupt]:
    """Stop gracefully at the first Ctrl-C or TERM, at once at the second."""
    interrupt = Interrupt()
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
