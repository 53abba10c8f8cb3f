"""Processes of this host that are tagged by a variable in their environment, whatever their parents (Linux)."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from fogspec.agent.processes import Process, below, living, offspring, send
from fogspec.base import child

PROC = "/proc"
KERNELS = 0x00200000  # PF_KTHREAD in include/linux/sched.h
CHECKS, CHECK_S = 4, 0.03
KILL_S = 10.0
Find = Callable[[], set[int]]


def marked(variable: str, value: str) -> list[int]:
    """Return the living processes whose environment has this variable with this value."""
    mark = f"{variable}={value}".encode()
    # A zombie's environment is empty.
    return [pid for pid, words in environments() if mark in words]


def environments() -> Iterator[tuple[int, list[bytes]]]:
    """Yield every readable process with the entries of its environment; one that is in exec has none, and is waited for."""
    left = [int(entry) for entry in os.listdir(PROC) if entry.isdigit()]
    for check in range(CHECKS):
        if check and not (left := [pid for pid in left if _in_exec(pid)]):
            return
        if check:
            time.sleep(CHECK_S)
        for pid in list(left):
            with contextlib.suppress(OSError):
                content = Path(PROC, str(pid), "environ").read_bytes()
                if content:
                    left.remove(pid)
                    yield pid, content.split(b"\0")


def _in_exec(pid: int) -> bool:
    """Return whether a process without an environment has no arguments either, and is neither a zombie nor the kernel's."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        state, *rest = Path(PROC, str(pid), "stat").read_bytes().rpartition(b")")[2].split()
        return state not in b"ZX" and not int(rest[5]) & KERNELS and not Path(PROC, str(pid), "cmdline").read_bytes()
    return False


def found(variable: str, value: str) -> list[int]:
    """Like `marked`, but recheck before reporting none."""
    return sorted(_rechecked(lambda: set(marked(variable, value))))


def members(variable: str, value: str, also: Callable[[dict[int, Process]], set[int]] = lambda _: set()) -> set[int]:
    """Return the tagged processes, those of their sessions, those that `also` adds, and all that descend from them.

    A process may drop its environment, its session or its parent; one that drops all three is among `also` if this process
    adopted it. A session counts if it was made by a tagged process: its leader is tagged or gone.
    """
    known, tagged = living(), set(marked(variable, value)) - {os.getpid()}
    tagged &= known.keys()
    sessions = {known[pid].session for pid in tagged} - {os.getsid(0)}
    sessions = {one for one in sessions if one in tagged or one not in known}
    all_of = tagged | {pid for pid, one in known.items() if one.session in sessions} | also(known)
    return all_of | below(all_of, known)


def orphans(variable: str, value: str, before: Collection[int]) -> set[int]:
    """Return this process's children of other sessions, without those in `before`: it adopted them.

    One that is tagged with another value belongs to another.
    """
    own, found = os.getsid(0), set[int]()
    for pid in set(offspring()) - set(before):
        with contextlib.suppress(OSError):
            if os.getsid(pid) != own and not _is_of_another(pid, variable, value):
                found.add(pid)
    return found


def _is_of_another(pid: int, variable: str, value: str) -> bool:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/environ", "rb") as file:
        words = file.read().split(b"\0")
        return (
            any(word.startswith(f"{variable}=".encode()) for word in words)
            and f"{variable}={value}".encode() not in words
        )
    return False


def end(find: Find, grace_s: float, force: Callable[[], object] = lambda: None) -> list[int]:
    """Send TERM, after `grace_s` call `force`, and kill until `find` finds no process; return those that are left.

    TERM goes to the uppermost of them, which pass it on: a launcher looks first at what the others have in shared memory.
    """
    if not (some := _rechecked(find)):
        force()
        return []
    known = living()
    send([pid for pid in some if pid not in known or known[pid].parent not in some], signal.SIGTERM)
    until_s = time.monotonic() + grace_s
    while find() and time.monotonic() < until_s:
        time.sleep(0.05)
    force()
    return _killed(find)


def _killed(find: Find) -> list[int]:
    """Kill until nothing is found; all are stopped before the first is killed: others may start again what is killed."""
    until_s, stopped, tries = time.monotonic() + KILL_S, set[int](), 0
    # A few tries whatever the time: the computer may have stood still.
    while (left := _rechecked(find)) and (time.monotonic() < until_s or tries < CHECKS):
        tries += 1
        if new := left - stopped:
            stopped |= send(new, signal.SIGSTOP)
            continue
        send(left, signal.SIGKILL)
        stopped.clear()
        time.sleep(0.005)
    return sorted(left)


def bury(pids: Collection[int]) -> None:
    """Reap children that have ended."""
    for pid in pids:
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, os.WNOHANG)


def _rechecked(find: Find) -> set[int]:
    for _ in range(CHECKS - 1):
        if pids := find():
            return pids
        time.sleep(CHECK_S)
    return find()


def equipped(environment: Mapping[str, str], out: Path) -> dict[str, str]:
    """Return the environment of a task's run script on this host: output goes to `out`, and the agent runs in this Python.

    Nodes get the `python3` that the user's shell has, with the user's packages; this one only where it has none.
    """
    path = os.pathsep.join([child.environment().get("PATH", os.defpath), str(Path(sys.executable).parent)])
    return {**environment, "PATH": path, "FOGSPEC_PYTHON": sys.executable, "FOGSPEC_OUT": str(out.absolute())}
