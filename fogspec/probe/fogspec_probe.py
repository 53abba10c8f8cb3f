"""Times requests inside your own code, in three lines; does nothing unless fogspec is measuring.

    import fogspec_probe
    fogspec_probe.start("plan")
    ...
    fogspec_probe.stop("plan")

Standard library only. Each finished request is one line of JSON appended to the file FOGSPEC_TIMINGS.
"""

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator

_here = threading.local()
_lock = threading.Lock()
_file: int | None = None


def start(name: str) -> None:
    """A request begins now, on this thread."""
    if "FOGSPEC_TIMINGS" in os.environ:
        _started()[name] = time.monotonic()


def stop(name: str, ok: bool = True, reason: str | None = None, **metrics: float) -> None:
    """The request that this thread started ends now; `ok` is whether its answer is good, `metrics` are its measures."""
    _stop(name, ok, reason, metrics)


def _stop(name: str, ok: bool, reason: str | None, metrics: dict[str, float]) -> None:
    now = time.monotonic()
    begun = _started().pop(name, None)
    if begun is None:
        return
    record = {"name": name, "start_s": begun, "latency_s": now - begun, "ok": bool(ok), "reason": reason,
              "metrics": {key: float(value) for key, value in metrics.items()}}  # fmt: skip
    _append((json.dumps(record) + "\n").encode())


@contextlib.contextmanager
def request(name: str) -> Iterator[dict[str, float]]:
    """Times a block; what is put into the mapping are its metrics, an exception makes it a failed request."""
    metrics: dict[str, float] = {}
    start(name)
    try:
        yield metrics
    except BaseException as problem:
        stop(name, ok=False, reason=type(problem).__name__)
        raise
    _stop(name, True, None, metrics)


def _started() -> dict[str, float]:
    if not hasattr(_here, "started"):
        _here.started = {}
    started: dict[str, float] = _here.started
    return started


def _append(line: bytes) -> None:
    global _file
    with _lock:
        if _file is None:
            _file = os.open(os.environ["FOGSPEC_TIMINGS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    os.write(_file, line)
