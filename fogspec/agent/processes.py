"""The processes below this one (Linux): start them in one environment, end all of them, detect out-of-memory kills."""

import contextlib
import ctypes
import os
import re
import signal
import subprocess
import time
from pathlib import Path

VMSTAT = Path("/proc/vmstat")
PR_SET_CHILD_SUBREAPER = 36


def is_argv(value: object) -> bool:
    """Return whether a JSON value is a command: a non-empty list of strings."""
    return isinstance(value, list) and bool(value) and all(isinstance(word, str) for word in value)


# `-m` would import from the working folder before all else: a node's folder may have a `queue.py` of its own.
OURS = "fogspec_agent."
START = "import runpy, sys; sys.path[:] = filter(None, sys.path); "
START += "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"


def apart(argv: list[str]) -> list[str]:
    """Return the command; a program of this package is started so that it imports nothing from the working folder."""
    ours = argv[1:2] == ["-m"] and argv[2:3] and argv[2].startswith(OURS)
    return [argv[0], "-c", START, *argv[2:]] if ours else argv


def environment(out: Path, timings: Path) -> dict[str, str]:
    """Return this process's environment, with the extracted agent on PYTHONPATH and the timings file."""
    path = os.pathsep.join(filter(None, [str(out / "python"), os.environ.get("PYTHONPATH")]))
    return dict(os.environ, PYTHONPATH=path, FOGSPEC_TIMINGS=str(timings))


def received_signals() -> list[int]:
    """Return a list to which TERM, INT and HUP are appended from now on, instead of ending this process."""
    received: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda got, _frame: received.append(got))
    return received


def adopt_orphans() -> None:
    """Keep processes that detach themselves below this one, so that `finish` ends them too."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def finish(children: list[subprocess.Popen[bytes]]) -> None:
    """End the processes and all they started: INT (as ROS nodes expect), TERM, KILL, each after a delay."""
    for number, patience_s in ((signal.SIGINT, 2.0), (signal.SIGTERM, 1.0), (signal.SIGKILL, 5.0)):
        for pid in descendants():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, number)
        end_s = time.monotonic() + patience_s
        while descendants() and time.monotonic() < end_s:
            time.sleep(0.02)
        for child in children:
            child.poll()
    # Reap adopted processes: not every machine's init does.
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def descendants() -> list[int]:
    """Return the ids of the living processes below this one, without zombies."""
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
    """Return how often the kernel killed a process for lack of memory: in this cgroup, or on this host if unknown.

    The cgroup comes first because the kill of another user's process on the same host indicates nothing.
    """
    for path in (*memory_counters(), VMSTAT):
        with contextlib.suppress(OSError):
            if found := re.findall(rb"^oom_kill (\d+)$", path.read_bytes(), re.MULTILINE):
                return sum(map(int, found))
    return 0


def memory_counters() -> list[Path]:
    """Return the files in which this process's cgroup (v1 or v2) counts such kills; the root cgroup has none."""
    found = []
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, names, path = line.split(":", 2)
            if path != "/" and "memory" in names.split(","):
                found.append(Path(f"/sys/fs/cgroup/memory{path}/memory.oom_control"))
            elif path != "/" and not names:
                found.append(Path(f"/sys/fs/cgroup{path}/memory.events"))
    return found


def exit_text(code: int) -> str:
    """Return an exit code as a phrase, with the signal's name if a signal ended the process."""
    return f"was ended by {signal_name(-code)}" if code < 0 else f"ended with exit code {code}"


def signal_name(number: int) -> str:
    """Return a signal's number and description."""
    return f"signal {number} ({signal.strsignal(number)})"
