"""Processes of this host that are tagged by a variable in their environment, whatever their parents (Linux)."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from fogspec.base import child

CHECKS = 4


def marked(variable: str, value: str) -> list[int]:
    """Return the living processes whose environment has this variable with this value."""
    mark = f"{variable}={value}".encode()
    # A zombie's environment is empty.
    return [pid for pid, words in environments() if mark in words]


def environments() -> Iterator[tuple[int, list[bytes]]]:
    """Yield every readable process with the entries of its environment."""
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            yield int(entry), Path("/proc", entry, "environ").read_bytes().split(b"\0")


def found(variable: str, value: str) -> list[int]:
    """Like `marked`, but recheck before reporting none: during exec a process has no environ."""
    for _ in range(CHECKS - 1):
        if pids := marked(variable, value):
            return pids
        time.sleep(0.03)
    return marked(variable, value)


def send(pids: Iterable[int], number: int) -> int:
    """Send a signal; return how many processes received it."""
    count = 0
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
            count += 1
    return count


def end(variable: str, value: str, grace_s: float) -> list[int]:
    """Send TERM, then after `grace_s` KILL, to all tagged processes; return those that are left."""
    for number, timeout_s in ((signal.SIGTERM, grace_s), (signal.SIGKILL, 5.0)):
        if not send(found(variable, value), number):
            return []
        until = time.monotonic() + timeout_s
        while marked(variable, value) and time.monotonic() < until:
            time.sleep(0.05)
    return marked(variable, value)


def equipped(environment: Mapping[str, str], out: Path) -> dict[str, str]:
    """Return the environment of a task's run script on this host: this Python comes first, output goes to `out`."""
    path = os.pathsep.join([str(Path(sys.executable).parent), child.environment().get("PATH", os.defpath)])
    return {**environment, "PATH": path, "FOGSPEC_OUT": str(out.absolute())}
