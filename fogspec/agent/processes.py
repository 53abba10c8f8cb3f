"""The processes below this one: how they are ended, all of them, and why the kernel may have ended some (Linux)."""

import contextlib
import os
import re
import signal
import subprocess
import time
from pathlib import Path

VMSTAT = Path("/proc/vmstat")


def finish(children: list[subprocess.Popen[bytes]]) -> None:
    """End the processes and all they started: INT (what ROS nodes expect), TERM, KILL, each after a while."""
    for number, patience in ((signal.SIGINT, 2.0), (signal.SIGTERM, 1.0), (signal.SIGKILL, 5.0)):
        for pid in descendants():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, number)
        end = time.monotonic() + patience
        while descendants() and time.monotonic() < end:
            time.sleep(0.02)
        for child in children:
            child.poll()
    # Whoever was adopted is buried too: not every machine's first process does that.
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def descendants() -> list[int]:
    """The living processes below this one, zombies left out (Linux)."""
    below: dict[int, list[int]] = {}
    dead = set()
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            state, parent = Path("/proc", entry, "stat").read_bytes().rsplit(b")", 1)[1].split()[:2]
            below.setdefault(int(parent), []).append(int(entry))
            if state in b"ZX":
                dead.add(int(entry))
    found, frontier = [], [os.getpid()]
    while frontier:
        frontier = [pid for parent in frontier for pid in below.get(parent, [])]
        found += [pid for pid in frontier if pid not in dead]
    return found


def memory_kills() -> int:
    """How often the kernel ended a process for want of memory in this one's cgroup, or where that cannot be told, here (Linux).

    Somebody else's process on the same host says nothing of ours.
    """
    for path in (*own_counters(), VMSTAT):
        with contextlib.suppress(OSError):
            if found := re.findall(rb"^oom_kill (\d+)$", path.read_bytes(), re.MULTILINE):
                return sum(map(int, found))
    return 0


def own_counters() -> list[Path]:
    """The files in which this process's cgroup, of either version, counts such ends; not of the root, where none is kept."""
    found = []
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, names, path = line.split(":", 2)
            if path != "/" and "memory" in names.split(","):
                found.append(Path(f"/sys/fs/cgroup/memory{path}/memory.oom_control"))
            elif path != "/" and not names:
                found.append(Path(f"/sys/fs/cgroup{path}/memory.events"))
    return found


def named(number: int) -> str:
    """A signal in words."""
    return f"signal {number} ({signal.strsignal(number)})"
