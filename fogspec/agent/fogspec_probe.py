"""Times requests inside your own code, in three lines; does nothing unless fogspec is measuring.

    import fogspec_probe
    fogspec_probe.start("plan")
    ...
    fogspec_probe.stop("plan")

A request whose answer fails your own check is stopped with `ok=False` and a reason, so that it does not count as a
fast one. Metrics are numbers by name: `stop("plan", path_length_m=12.5)`. Standard library only; each finished request
is one line of JSON appended to the file FOGSPEC_TIMINGS. Threads and processes may time requests at the same time: a
request belongs to the thread that started it, and a line is one write.
"""

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

_here = threading.local()


def start(name: str) -> None:
    """A request begins now, on this thread."""
    if "FOGSPEC_TIMINGS" in os.environ:
        vars(_here)[name] = time.monotonic()


def stop(name: str, ok: bool = True, reason: str | None = None, scenario: str | None = None, **metrics: float) -> None:
    """The request that this thread started ends now; without one, nothing happens.

    `scenario` is its kind, where the spec weighs several kinds of request.

    Raises TypeError or ValueError for a metric that is no number, and OSError when the line cannot be written: a
    benchmark that lost measurements must not look like one that has them.
    """
    now = time.monotonic()
    begun = vars(_here).pop(name, None)
    if begun is None:
        return
    record = {
        "name": name,
        "start_s": begun,
        "latency_s": now - begun,
        "ok": bool(ok),
        "reason": reason,
        "metrics": {key: float(value) for key, value in metrics.items()},
    }
    if scenario is not None:
        record["scenario"] = scenario
    # Opened anew each time: nothing to share between threads and forked processes.
    file = os.open(os.environ["FOGSPEC_TIMINGS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(file, (json.dumps(record) + "\n").encode())
    finally:
        os.close(file)


@contextlib.contextmanager
def request(name: str) -> Iterator[dict[str, Any]]:
    """Times a block. What is put into the mapping is given to `stop`; an exception makes it a failed request."""
    told: dict[str, Any] = {}
    start(name)
    try:
        yield told
    except BaseException as problem:
        stop(name, ok=False, reason=type(problem).__name__)
        raise
    stop(name, **told)
