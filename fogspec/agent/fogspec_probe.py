"""Time requests inside your own code, in three lines; it does nothing unless fogspec is measuring.

    import fogspec_probe
    fogspec_probe.start("plan")
    ...
    fogspec_probe.stop("plan")

A request belongs to the thread or the asyncio task that started it, and requests may overlap and be nested. Where another
thread or callback ends it, keep what `start` returned: `one = fogspec_probe.start("plan")`, and there `one.stop()`.

If a response fails your own check, stop its request with `ok=False` and a reason, so that it does not count as a fast
one. Metrics are numbers by name: `stop("plan", path_length_m=12.5)`. Standard library only; each start and each end of a
request is one line of JSON, appended to the file FOGSPEC_TIMINGS by one write: a request that never ends is known, too. The
line of a start is written before the clock is read, that of an end after.

It needs Python 3.10 and no ROS. It comes with fogspec; for a robot without fogspec it is a wheel of its own, fogspec-probe.
"""

import contextlib
import itertools
import json
import os
import sys
import time
from collections.abc import Iterator
from contextvars import ContextVar
from types import FrameType
from typing import Any

# Beyond these, the oldest open request of a place is forgotten: the numbers in the lines tell that it never ended.
MOST_HERE, MOST_OPEN = 100, 1000


class Request:
    """A request that was started: its `number` counts the starts of its name in its process, from 1."""

    __slots__ = ("ended", "name", "number", "process", "start_s")

    def __init__(self, name: str, number: int) -> None:
        self.name, self.number = name, number
        self.process, self.ended, self.start_s = _process, False, 0.0

    def stop(self, ok: bool = True, reason: str | None = None, scenario: str | None = None, **metrics: float) -> None:
        """End it, on any thread of its process; arguments and errors are those of the function `stop`."""
        _finish(time.monotonic(), self, ok, reason, scenario, metrics)


# Where a request was started: the frame of a function that still runs, the id of that of a coroutine or generator, or None.
Place = FrameType | int | None
# The flags of generators, coroutines and both, as in inspect, which takes 10 ms to import in each node.
SUSPENDED = 0x20 | 0x80 | 0x200

_here: "ContextVar[tuple[tuple[Request, Place], ...]]" = ContextVar("fogspec_probe", default=())
_process = ""
_counts: dict[str, "itertools.count[int]"] = {}
_open: dict[str, dict[int, Request]] = {}


def _begin_process() -> None:
    global _process
    _process = f"{os.getpid()}-{time.monotonic_ns():x}"
    _counts.clear()
    _open.clear()


_begin_process()
os.register_at_fork(after_in_child=_begin_process)


def start(name: str) -> Request:
    """Start a request of this thread or task, and return it; raise OSError if its line cannot be written."""
    if "FOGSPEC_TIMINGS" not in os.environ:
        return Request(name, 0)
    one = Request(name, next(_counts.setdefault(name, itertools.count(1))))
    caller = sys._getframe(1)
    here = _here.get()
    _here.set((*(_still(here, caller) if here else ()), (one, _place(caller))))
    opened = _open.setdefault(name, {})
    opened[one.number] = one
    if len(opened) > MOST_OPEN:
        with contextlib.suppress(RuntimeError, KeyError):  # another thread was faster
            opened.pop(next(iter(opened))).ended = True
    begun = {"open": name, "process": one.process, "number": one.number, "start_s": time.monotonic()}
    if command := os.environ.get("FOGSPEC_COMMAND"):
        begun["command"] = command
    _append(begun)
    one.start_s = time.monotonic()
    return one


def stop(name: str, ok: bool = True, reason: str | None = None, scenario: str | None = None, **metrics: float) -> None:
    """End the request of this name that this thread or task started.

    Of several, the one that the calling function started, or else the newest. Where it started none, the only open one of the
    process is ended. `scenario` is the kind of request, if the spec weighs several.

    Raise TypeError or ValueError for a metric that is not a number, and OSError if the line cannot be written: a benchmark
    that lost measurements must not look complete.
    """
    now_s = time.monotonic()
    if "FOGSPEC_TIMINGS" not in os.environ:
        return
    open_here = [(one, place) for one, place in _here.get() if one.name == name and not one.ended]
    # A suspended coroutine shares the thread with others, and a function that calls itself with its caller.
    caller = _place(sys._getframe(1))
    own = [one for one, place in open_here if place == caller] or [one for one, _ in open_here]
    own = [one for one in own if one.process == _process] or own
    others = [] if own else list(_open.get(name, {}).copy().values())
    if own or len(others) == 1:
        _finish(now_s, (own or others)[-1], ok, reason, scenario, metrics, own[-2].number if len(own) > 1 else None)
    else:
        _unmatched(now_s, name, f"where none was started, while {len(others)} were open in its process")


def _place(frame: FrameType) -> Place:
    # A frame keeps its variables alive: only one that runs is kept.
    return id(frame) if frame.f_code.co_flags & SUSPENDED else frame


def _still(here: "tuple[tuple[Request, Place], ...]", caller: FrameType) -> "list[tuple[Request, Place]]":
    """Return the open requests, without the places of functions that have ended, so that none takes them for its own."""
    running, frame = set[FrameType](), caller.f_back
    while frame is not None:
        running.add(frame)
        frame = frame.f_back
    running.add(caller)
    return [
        (one, place if isinstance(place, int) or place in running else None)
        for one, place in here[1 - MOST_HERE :]
        if not one.ended
    ]


def _finish(
    now_s: float,
    one: Request,
    ok: bool,
    reason: str | None,
    scenario: str | None,
    metrics: dict[str, float],
    above: int | None = None,
) -> None:
    if not one.number or "FOGSPEC_TIMINGS" not in os.environ:
        return
    _here.set(tuple(other for other in _here.get() if other[0] is not one and not other[0].ended))
    if one.ended or one.process != _process:
        why = "for the second time" if one.ended else "in another process than that of its start"
        _unmatched(now_s, one.name, why)
        return
    one.ended = True
    _open.get(one.name, {}).pop(one.number, None)
    record = {
        "name": one.name,
        "process": one.process,
        "number": one.number,
        "start_s": one.start_s,
        "latency_s": now_s - one.start_s,
        "ok": bool(ok),
        "reason": reason,
        "metrics": {key: float(value) for key, value in metrics.items()},
    }
    if scenario is not None:
        record["scenario"] = scenario
    if above is not None:
        record["above"] = above
    _append(record)


def _unmatched(at_s: float, name: str, why: str) -> None:
    _append({"name": name, "unmatched": True, "process": _process, "at_s": at_s, "reason": f"stopped {why}"})


def _append(record: dict[str, Any]) -> None:
    # Reopened each time: nothing is shared between threads and forked processes.
    file = os.open(os.environ["FOGSPEC_TIMINGS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(file, (json.dumps(record) + "\n").encode())
    finally:
        os.close(file)


@contextlib.contextmanager
def request(name: str) -> Iterator[dict[str, Any]]:
    """Time a block; the mapping's items become arguments of `stop`, an exception makes it a failed request."""
    arguments: dict[str, Any] = {}
    one = start(name)
    try:
        yield arguments
    except BaseException as problem:
        one.stop(ok=False, reason=type(problem).__name__)
        raise
    one.stop(**arguments)
