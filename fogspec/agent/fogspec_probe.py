"""Time requests inside your own code, in three lines; it does nothing unless fogspec is measuring.

    import fogspec_probe
    fogspec_probe.start("plan")
    ...
    fogspec_probe.stop("plan")

If a response fails your own check, stop its request with `ok=False` and a reason, so that it does not count as a fast
one. Metrics are numbers by name: `stop("plan", path_length_m=12.5)`. Standard library only; each finished request is one
line of JSON appended to the file FOGSPEC_TIMINGS. Threads and processes may time requests at the same time: a request
belongs to the thread that started it, and a line is one write. The first start of each name is a line too: a note, by which
a name that `probe.callback` misspells ends a sample at once.

It needs Python 3.10 and no ROS. It comes with fogspec; for a robot without fogspec it is a wheel of its own, fogspec-probe.
"""

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

_started = threading.local()
_noted: set[str] = set()


def start(name: str) -> None:
    """Start a request on this thread; raise OSError if the note of a name's first start cannot be written."""
    if "FOGSPEC_TIMINGS" not in os.environ:
        return
    if name not in _noted:
        _noted.add(name)
        _append({"note": f"{name!r} was started and has not ended", "started": name})
    vars(_started)[name] = time.monotonic()


def stop(name: str, ok: bool = True, reason: str | None = None, scenario: str | None = None, **metrics: float) -> None:
    """End the request that this thread started; do nothing if there is none.

    `scenario` is the kind of request, if the spec weighs several kinds.

    Raise TypeError or ValueError for a metric that is not a number, and OSError if the line cannot be written: a benchmark
    that lost measurements must not look complete.
    """
    now_s = time.monotonic()
    start_s = vars(_started).pop(name, None)
    if start_s is None:
        return
    record = {
        "name": name,
        "start_s": start_s,
        "latency_s": now_s - start_s,
        "ok": bool(ok),
        "reason": reason,
        "metrics": {key: float(value) for key, value in metrics.items()},
    }
    if scenario is not None:
        record["scenario"] = scenario
    _append(record)


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
    start(name)
    try:
        yield arguments
    except BaseException as problem:
        stop(name, ok=False, reason=type(problem).__name__)
        raise
    stop(name, **arguments)
