"""The processes below this one (Linux): start them in one environment, end all of them, detect out-of-memory kills."""

import contextlib
import ctypes
import os
import re
import select
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

VMSTAT = Path("/proc/vmstat")
PR_SET_CHILD_SUBREAPER = 36
KILL_S = 10.0
PASSED_ON = {signal.SIGINT, signal.SIGILL, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGKILL, signal.SIGSEGV,
             signal.SIGTERM}  # fmt: skip


def is_argv(value: object) -> bool:
    """Return whether a JSON value is a command: a non-empty list of strings."""
    return isinstance(value, list) and bool(value) and all(isinstance(word, str) for word in value)


# `-m` would import from the working folder before all else: a node's folder may have a `queue.py` of its own.
OURS = "fogspec_agent."
START = "import runpy, sys; sys.path[:] = filter(None, sys.path); "
START += "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"


def apart(argv: list[str]) -> list[str]:
    """Return the command; a program of this package runs in this Python, and imports nothing from the working folder."""
    ours = argv[1:2] == ["-m"] and argv[2:3] and argv[2].startswith(OURS)
    return [sys.executable, "-c", START, *argv[2:]] if ours else argv


def program(argv: list[str]) -> str:
    """Return the name of a command that has no other: of what it starts."""
    if f"{OURS}preload" in argv[:3] and "--" in argv:
        return program(argv[argv.index("--") + 1 :])
    if argv[:2] == ["sh", "-c"] and len(argv) > 2:
        return argv[2].removeprefix("exec ").partition(' "')[0]
    return f"fogspec's {argv[2].removeprefix(OURS)}" if apart(argv) != argv else os.path.basename(argv[0])


def environment(out: Path, timings: Path) -> dict[str, str]:
    """Return this process's environment, with the extracted agent on PYTHONPATH and the timings file."""
    path = os.pathsep.join(filter(None, [str(out / "python"), os.environ.get("PYTHONPATH")]))
    return dict(os.environ, PYTHONPATH=path, FOGSPEC_TIMINGS=str(timings))


def shown(argv: list[str]) -> str:
    """Return a command with its arguments, as far as people want to read it; only its name if it is not as they wrote it."""
    name = program(argv)
    return shlex.join(argv)[:100] if name == os.path.basename(argv[0]) else name


def told_apart(names: Iterable[str]) -> list[str]:
    """Return the names, the second of one name with a 2 behind it, and so on."""
    counts, found = dict[str, int](), list[str]()
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        found.append(name if counts[name] == 1 else f"{name} {counts[name]}")
    return found


def received_signals() -> list[int]:
    """Return a list to which TERM, INT and HUP are appended from now on, instead of ending this process."""
    received: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda got, _frame: received.append(got))
    return received


def adopt_orphans(adopt: bool = True) -> None:
    """Keep processes that detach themselves below this one, so that it ends them too."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, int(adopt), 0, 0, 0)


class Ends:
    """The order in which processes end, for the end of one often ends others: the kernel keeps it, however late one looks."""

    def __init__(self) -> None:
        self.ready, self.watched = select.epoll(), dict[int, subprocess.Popen[bytes]]()
        self.others: list[subprocess.Popen[bytes]] = []
        self.seen: list[subprocess.Popen[bytes]] = []

    def watch(self, process: "subprocess.Popen[bytes]") -> None:
        """Watch a process that was started just now, after a `look` for those that ended before its start.

        The order is not known of what ended between its start and this call. If it did so itself, it is the first: others end
        for lack of it.
        """
        try:
            file = os.pidfd_open(process.pid)
            self.ready.register(file, select.EPOLLIN)
            self.watched[file] = process
        except OSError:  # before Linux 5.3
            self.others.append(process)
            return
        if os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            self._take(file)

    def look(self) -> None:
        """Remember the order of the ends until now."""
        for file, _ in self.ready.poll(0):
            self._take(file)
        self.seen += [one for one in self.others if one.poll() is not None]
        self.others = [one for one in self.others if one not in self.seen]

    def new(self) -> "list[subprocess.Popen[bytes]]":
        """Return the processes that have ended since the last call, the first one first."""
        self.look()
        found, self.seen = self.seen, []
        return found

    def _take(self, file: int) -> None:
        self.ready.unregister(file)
        os.close(file)
        self.seen.append(self.watched.pop(file))


def finish(children: list[subprocess.Popen[bytes]]) -> None:
    """End the processes and all they started: INT (as ROS nodes expect), TERM, KILL, each after a delay."""
    for number, patience_s in ((signal.SIGINT, 2.0), (signal.SIGTERM, 1.0)):
        send(descendants(), number)
        end_s = time.monotonic() + patience_s
        while descendants() and time.monotonic() < end_s:
            time.sleep(0.02)
    extinguish(children)


def extinguish(children: Iterable[subprocess.Popen[bytes]] = (), patience_s: float = KILL_S) -> bool:
    """Kill and reap all processes below this one, which adopts orphans; return whether none is left after `patience_s`.

    All are stopped before the first is killed: what is stopped starts nothing, while others may start again what is killed. A
    process that ends once it has started the next is never seen for long, but cannot hide: a process that loses its parent
    becomes a child of this process, and when this process has no child, the kernel says so.
    """
    end_s, stopped = time.monotonic() + patience_s, set[int]()
    while not (gone := reap(children)) and time.monotonic() < end_s:
        if new := tree() - stopped:
            stopped |= send(new, signal.SIGSTOP)
            continue
        send(tree(), signal.SIGKILL)
        stopped.clear()
        time.sleep(0.001)
    return gone


def reap(children: Iterable[subprocess.Popen[bytes]] = ()) -> bool:
    """Reap what has ended below this process, adopted ones too; return whether no child is left, ended or not.

    Exit codes of `children` are kept for their owners.
    """
    own = {child.pid: child for child in children if child.returncode is None}
    try:
        while ended := os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            if child := own.pop(ended.si_pid, None):
                child.poll()
            else:
                os.waitpid(ended.si_pid, 0)
    except ChildProcessError:
        return True
    return False


def send(pids: Iterable[int], number: int) -> set[int]:
    """Send a signal, the latest processes first; return those that received it."""
    received = set()
    for pid in sorted(pids, reverse=True):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)
            received.add(pid)
    return received


@dataclass(frozen=True)
class Process:
    """A living process: its parent and its session."""

    parent: int
    session: int


def living() -> dict[int, Process]:
    """Return all processes by id, without zombies."""
    found = {}
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError, ValueError):
            with open(f"/proc/{entry}/stat", "rb") as file:
                state, parent, _, session = file.read().rsplit(b")", 1)[1].split()[:4]
            if state not in b"ZX":
                found[int(entry)] = Process(int(parent), int(session))
    return found


def below(roots: Iterable[int], processes: dict[int, Process]) -> set[int]:
    """Return the processes that descend from `roots`."""
    children: dict[int, list[int]] = {}
    for pid, one in processes.items():
        children.setdefault(one.parent, []).append(pid)
    found: set[int] = set()
    frontier = list(roots)
    while frontier:
        frontier = [pid for parent in frontier for pid in children.get(parent, []) if pid not in found]
        found.update(frontier)
    return found


def descendants() -> list[int]:
    """Return the ids of the living processes below this one."""
    return sorted(below([os.getpid()], living()))


def tree() -> set[int]:
    """Return the processes below this one, zombies included: as `descendants`, but in microseconds where the kernel can."""
    found: set[int] = set()
    frontier = offspring()
    while frontier:
        found.update(frontier)
        frontier = [child for pid in frontier for child in offspring(pid) if child not in found]
    return found or set(descendants())


def offspring(of: int | str = "self") -> list[int]:
    """Return the ids of a process's children, zombies included; none where the kernel does not list them."""
    found: list[int] = []
    with contextlib.suppress(OSError):
        for task in os.listdir(f"/proc/{of}/task"):
            with contextlib.suppress(OSError), open(f"/proc/{of}/task/{task}/children", "rb") as file:
                found += map(int, file.read().split())
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
    """Return an exit code as a phrase, with the signal's name if a signal ended the process, or one that it waited for.

    A shell, and launch, end with 128 and the number of the signal that ended what they started; `ros2 run` with its negative.
    """
    number = -code if code < 0 else code - 128 if code - 128 in PASSED_ON else 256 - code
    if number not in PASSED_ON and code >= 0:
        return f"ended with exit code {code}"
    text = "was killed (SIGKILL)" if number == signal.SIGKILL else f"was ended by {signal_name(number)}"
    return text if code < 0 else f"{text[:-1]}, exit code {code})"


def signal_name(number: int) -> str:
    """Return a signal's name and description, of one that has no name its number."""
    with contextlib.suppress(ValueError):
        return f"{signal.Signals(number).name} ({signal.strsignal(number)})"
    return f"signal {number}"
