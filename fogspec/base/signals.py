"""Ctrl-C: the first asks for a clean stop, the second insists. And an end to work that takes too long."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import process_time
from typing import Any

ENDS = (signal.SIGTERM, signal.SIGHUP)


@dataclass(slots=True)
class Interrupt:
    """Whether the user asked to stop: the first Ctrl-C stops cleanly, the second `insisted` and stops at once."""

    asked: bool = False
    answering: bool = False
    insisted: bool = False

    def __call__(self, number: int, _frame: Any) -> None:
        """Handle the signal."""
        if self.asked or self.answering:
            self.insist()
        self.asked = True

    def insist(self, _number: int = 0, _frame: Any = None) -> None:
        """Handle a signal that stops at once."""
        self.insisted = True
        raise KeyboardInterrupt

    @contextmanager
    def question(self) -> Iterator[None]:
        """Treat the first Ctrl-C during a prompt as its answer."""
        self.answering = True
        try:
            yield
        finally:
            self.answering = False


class TookTooLong(Exception):
    """Work used all the processor time that it may have."""


@dataclass(slots=True)
class Used:
    """The processor time that a block used, once it has ended."""

    seconds: float = 0.0


@contextmanager
def processor_time(seconds: float) -> Iterator[Used]:
    """Raise TookTooLong inside of the block once it has used so much processor time, even within a regular expression.

    Only in the main thread, where signals arrive; in another one nothing is limited.
    """
    used, begun = Used(), process_time()
    if threading.current_thread() is not threading.main_thread():
        yield used
        return

    def stop(_number: int, _frame: Any) -> None:
        raise TookTooLong

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield used
    finally:
        used.seconds = process_time() - begun
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


@contextmanager
def interruptible() -> Iterator[Interrupt]:
    """Stop gracefully at the first Ctrl-C, TERM or closed terminal (HUP), at once at the second."""
    with _handling((signal.SIGINT, *ENDS)) as interrupt:
        yield interrupt


@contextmanager
def finishing() -> Iterator[Interrupt]:
    """Go on at the first TERM or closed terminal (HUP): work that must not stop in the middle. Ctrl-C stops as ever."""
    with _handling(ENDS, at_once=(signal.SIGINT,)) as interrupt:
        yield interrupt


@contextmanager
def _handling(numbers: Iterable[signal.Signals], at_once: Iterable[signal.Signals] = ()) -> Iterator[Interrupt]:
    interrupt = Interrupt()
    theirs = (number for number in at_once if signal.getsignal(number) is signal.default_int_handler)
    handlers: dict[signal.Signals, Callable[[int, Any], None]] = {
        **dict.fromkeys(numbers, interrupt),
        **dict.fromkeys(theirs, interrupt.insist),
    }
    # What nohup and the like ignore stays ignored.
    heeded = [number for number in handlers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handlers[number]) for number in heeded}
    try:
        yield interrupt
    except Exception:
        # Raised while compiled code calls back, as pydantic does to serialise, it arrives as an error of that code.
        if interrupt.insisted:
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
            # What came in the last moment of the inner block is not lost for the outer one.
            if interrupt.asked and isinstance(handler, Interrupt):
                handler.asked = True
