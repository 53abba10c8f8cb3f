"""Resource limits of a process tree on this host: CPUs by affinity, memory by cgroup v2 if writable, else by rlimit.

Affinity is inherited by every descendant, so a sample of n CPUs runs on n CPUs of this host, and
`nproc`, OpenMP and the like see n. A cgroup bounds the memory of the whole tree. RLIMIT_DATA, the fallback, bounds
the private memory of each process by itself, so a tree of several processes may use more, and shared memory is not bounded.
A cgroup is used without its memory controller too: it ends all of its processes at once, however fast they start others.
Where there is none, namespaces do that for a sample, if this kernel lets this user have any, and bound `/dev/shm`.
"""

import contextlib
import errno
import fcntl
import functools
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import fogspec
from fogspec.base import child, host

MemoryBy = Literal["cgroup", "namespace", "rlimit"]
MEMORY_TEXT = {
    "cgroup": "by cgroup",
    "namespace": "by rlimit of each process and the size of /dev/shm (other shared memory is not limited)",
    "rlimit": "by rlimit of each process (shared memory is not limited)",
}

CLAIM = "/sys/devices/system/cpu/cpu{}/topology/thread_siblings_list"  # of a CPU, locked and not written
GROUP = "fogspec-"  # the beginning of the names of cgroups

# A process of its own: affinity, limits and namespaces must not affect the caller.
LAUNCHER = "import sys; sys.path.append(sys.argv.pop(1)); from fogspec.backends.local.launcher import main; main()"
KILL_S = 5.0  # that the launcher gets to kill what is left


@dataclass(slots=True)
class LimitedProcess:
    """A process tree with limits that this process started."""

    process: "subprocess.Popen[bytes]"
    cpus: tuple[int, ...]
    memory_by: MemoryBy
    group: Path | None
    grace_s: float

    def poll(self) -> int | None:
        """Return the exit code of the first process; None while it runs."""
        return self.process.poll()

    def outcome(self) -> Literal["out_of_memory"] | None:
        """Return whether the kernel killed one of its processes for lack of memory, if a cgroup recorded it."""
        return "out_of_memory" if _events(self.group).get("oom_kill", 0) else None

    def end(self) -> None:
        """Terminate the program, after its grace kill all that it started, then all of its session and cgroup."""
        if self.poll() is None:
            self.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(self.grace_s + KILL_S)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, 9)
        if self.process.poll() is None:
            self.process.wait(5)
        if self.group is not None:
            end_group(self.group)


def start(
    argv: Sequence[str],
    *,
    cpus: int,
    memory_gib: float,
    cwd: Path,
    env: Mapping[str, str],
    log: BinaryIO,
    name: str,
    grace_s: float,
    apart: bool = False,
) -> LimitedProcess:
    """Start `argv` on `cpus` CPUs with `memory_gib` of memory, its output to `log`; raise OSError if it cannot be started.

    Once it ends, or `grace_s` after it was signaled, all that it started is killed. Its cgroup, if it gets one, is called
    `name`, by which `groups` finds it; if it gets none and is to be `apart`, it gets namespaces where this host has them.
    Raise ValueError if this host has fewer CPUs.
    """
    with claimed_cpus(cpus) as (chosen, claims):
        if not cwd.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(cwd))
        limit_bytes = math.floor(memory_gib * 2**30)
        group, limited = _new_group(name, limit_bytes)
        memory_by: MemoryBy = (
            "cgroup" if limited else "namespace" if apart and not group and has_namespaces() else "rlimit"
        )
        words = _command(
            [child.program(argv[0]), *argv[1:]],
            cpus=chosen,
            data_bytes=None if limited else limit_bytes,
            group=group,
            apart_bytes=limit_bytes if memory_by == "namespace" else None,
            grace_s=grace_s,
            folder=cwd,
        )
        try:
            process = subprocess.Popen(
                words,
                cwd=child.ELSEWHERE,
                env=dict(env),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                pass_fds=claims,
            )
        except OSError:
            if group:
                group.rmdir()
            raise
        return LimitedProcess(process, chosen, memory_by, group, grace_s)


def _command(
    program: Sequence[str],
    *,
    cpus: Sequence[int],
    data_bytes: int | None = None,
    group: Path | None = None,
    apart_bytes: int | None = None,
    grace_s: float = 0.0,
    folder: Path = Path(child.ELSEWHERE),
) -> list[str]:
    numbers = ["" if number is None else str(number) for number in (data_bytes, group, apart_bytes)]
    given = [",".join(map(str, cpus)), *numbers, str(grace_s), str(folder.absolute())]
    own = str(Path(fogspec.__file__).absolute().parents[1])
    return [sys.executable, "-I", "-S", "-c", LAUNCHER, own, *given, *program]


@functools.cache
def has_namespaces() -> bool:
    """Return whether this user may start processes in namespaces of their own: many containers and some hosts forbid it."""
    words = _command([child.program("true")], cpus=pick_cpus(1), apart_bytes=2**20)
    try:
        tried = subprocess.run(words, cwd=child.ELSEWHERE, stdin=subprocess.DEVNULL, capture_output=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return tried.returncode == 0


def pick_cpus(count: int) -> tuple[int, ...]:
    """Return so many of the CPUs this process may use, one of each physical core first; raise ValueError for too many."""
    return tuple(sorted(_in_turn(count)[:count]))


@contextlib.contextmanager
def claimed_cpus(count: int) -> Iterator[tuple[tuple[int, ...], list[int]]]:
    """Yield CPUs as `pick_cpus`, those first that no other job on this host has claimed, and descriptors that claim them.

    A claim is a lock on a file of the kernel's about this CPU: the process that inherits it holds it until it ends, however it
    ends. Where there is no such file, nothing is claimed.
    """
    claims, shared = dict[int, BinaryIO](), list[int]()
    with contextlib.ExitStack() as held:
        for cpu in _in_turn(count):
            if len(claims) == count:
                break
            try:
                one = held.enter_context(open(CLAIM.format(cpu), "rb"))
                fcntl.flock(one, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                shared.append(cpu)
            else:
                claims[cpu] = one
        chosen = [*claims, *shared][:count]
        yield tuple(sorted(chosen)), [one.fileno() for one in claims.values()]


def _in_turn(count: int) -> list[int]:
    usable = sorted(os.sched_getaffinity(0))
    if count > len(usable):
        raise ValueError(f"{count} CPUs were requested, this process may use {len(usable)}")
    cores: dict[str, int] = {}
    turn = {}
    for cpu in usable:
        core = _core(cpu)
        turn[cpu] = cores.get(core, 0)
        cores[core] = turn[cpu] + 1
    return sorted(usable, key=lambda cpu: (turn[cpu], cpu))


def groups(name: str) -> list[Path]:
    """Return the cgroups that `start` made under this name, by whatever process."""
    return [Path(at, name) for at, below, _ in os.walk(host.version_2()) if name in below]


def end_group(group: Path) -> None:
    """Kill all processes of a cgroup and of those below it, and remove them as far as they are empty."""
    with contextlib.suppress(OSError), open(group / "cgroup.kill", "w") as file:
        file.write("1")
    for _ in range(50):
        for at, _, _ in os.walk(group, topdown=False):
            with contextlib.suppress(OSError):
                os.rmdir(at)
        if not group.is_dir():
            return
        time.sleep(0.05)


def memory_by() -> MemoryBy:
    """Return how the memory of a sample is limited on this host."""
    group, limited = _new_group(f"{GROUP}{os.getpid()}-{time.monotonic_ns()}", 2**30)
    if group is not None:
        end_group(group)
        return "cgroup" if limited else "rlimit"
    return "namespace" if has_namespaces() else "rlimit"


def _core(cpu: int) -> str:
    return host.text(Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")) or str(cpu)


def _new_group(name: str, limit_bytes: int) -> tuple[Path | None, bool]:
    """Return a new cgroup that a child of this process may enter, None if that is impossible, and whether it has this limit.

    It is below this process's own one, or next to it: except for the root, a cgroup with processes cannot have cgroups
    with limits below it. Without a memory controller it is there to end its processes.
    """
    # Moving a process requires write access to the common ancestor of both cgroups.
    possible = [above / name for above in host.limiting("")[:2] if os.access(above / "cgroup.procs", os.W_OK)]
    for group in possible:
        with contextlib.suppress(OSError):
            group.mkdir()
            try:
                _limit(group, limit_bytes)
            except OSError:
                group.rmdir()
                continue
            return group, True
    for group in possible:
        with contextlib.suppress(OSError):
            group.mkdir()
            if (group / "cgroup.kill").exists():
                return group, False
            group.rmdir()
    return None, False


def _limit(group: Path, limit_bytes: int) -> None:
    # Opened without creating it: if it is missing, there is no memory controller.
    with open(group / "memory.max", "r+") as file:
        file.write(str(limit_bytes))
    with contextlib.suppress(OSError), open(group / "memory.swap.max", "r+") as file:
        file.write("0")


def _events(group: Path | None) -> dict[str, int]:
    rows = (line.split() for line in host.text(group / "memory.events").splitlines()) if group else ()
    return {row[0]: int(row[1]) for row in rows if len(row) == 2 and row[1].isdigit()}
