"""Starts a program with limits and keeps what it starts below this process: its end is the end of all of them (Linux).

    CPUS DATA_BYTES GROUP APART_BYTES GRACE_S FOLDER PROGRAM [ARGUMENT ...]

The program runs on CPUS (`0,2`), in FOLDER, with at most DATA_BYTES of private memory in each process, and in the cgroup
GROUP; an empty word sets no such limit. With APART_BYTES it gets namespaces of its own, of processes and of mounts, in which
`/dev/shm` is empty and has that size: what is in there cannot name a process outside, and the kernel ends all of it with its
first process. TERM, INT and HUP are passed on; after GRACE_S more seconds all is killed. The exit code is the program's, or
128 and the number of the signal that ended it.
"""

import contextlib
import ctypes
import math
import os
import resource
import signal
import sys
import time

from fogspec.agent.processes import adopt_orphans, descendants, extinguish, send
from fogspec.agent.shared_memory import FOLDER, SharedMemory

PASSED_ON = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
WAITED_FOR = (signal.SIGCHLD, *PASSED_ON)
KILL_S = 60.0
CANNOT = 126  # as a shell says of a program that cannot be started

# <linux/sched.h>, <linux/mount.h>, <linux/prctl.h>
CLONE_NEWNS, CLONE_NEWUSER, CLONE_NEWPID = 0x00020000, 0x10000000, 0x20000000
MS_NOSUID, MS_NODEV, MS_NOEXEC, MS_REC, MS_SLAVE = 2, 4, 8, 0x4000, 0x80000
PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the program and exit as it does."""
    cpus, data_bytes, group, apart_bytes, grace_s, folder, *program = sys.argv[1:]
    signal.pthread_sigmask(signal.SIG_BLOCK, WAITED_FOR)
    adopt_orphans()
    memory = SharedMemory()
    try:
        if apart_bytes:
            leave_namespaces()
        if (first := os.fork()) == 0:
            if apart_bytes:
                first = begin_namespaces(int(apart_bytes))
            if first == 0:
                limit(cpus, data_bytes, group)
                os.chdir(folder)
                signal.pthread_sigmask(signal.SIG_UNBLOCK, WAITED_FOR)
                os.execv(program[0], program)  # noqa: S606
    except OSError as problem:
        print(f"fogspec: {program[0]} cannot be started: {problem}", file=sys.stderr, flush=True)
        os._exit(CANNOT)
    code = wait(first, float(grace_s))
    if os.getpid() != 1:  # with the first process of a namespace, all of it ends
        end_all(group, memory)
    os._exit(code)


def limit(cpus: str, data_bytes: str, group: str) -> None:
    """Set the limits of this process and of all that it starts."""
    if group:
        with open(os.path.join(group, "cgroup.procs"), "w", encoding="ascii") as file:
            file.write(str(os.getpid()))
    os.sched_setaffinity(0, set(map(int, cpus.split(","))))
    if data_bytes:
        resource.setrlimit(resource.RLIMIT_DATA, (int(data_bytes), int(data_bytes)))


def wait(first: int, grace_s: float) -> int:
    """Pass signals on; return the exit code of the first process, or that of KILL `grace_s` after the first signal."""
    until_s = math.inf
    while (left_s := until_s - time.monotonic()) > 0:
        if (got := signal.sigtimedwait(WAITED_FOR, min(left_s, 3600.0))) and got.si_signo in PASSED_ON:
            send([first], got.si_signo)
            until_s = min(until_s, time.monotonic() + grace_s)
        while ended := os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            if ended.si_pid == first:
                return ended.si_status + (0 if ended.si_code == os.CLD_EXITED else 128)
            os.waitpid(ended.si_pid, 0)  # it was adopted
    return 128 + signal.SIGKILL


def end_all(group: str, memory: SharedMemory) -> None:
    """End all processes below this one, and remove what they leave in shared memory."""
    memory.look(descendants, again=True)
    if group:
        with contextlib.suppress(OSError), open(os.path.join(group, "cgroup.kill"), "w", encoding="ascii") as file:
            file.write("1")
    extinguish(patience_s=KILL_S)
    memory.remove()


def leave_namespaces() -> None:
    """Let the next child begin namespaces of processes and mounts, if need be in one of users: without being root."""
    user, own_group = os.geteuid(), os.getegid()
    try:
        _call("unshare", CLONE_NEWPID | CLONE_NEWNS)
    except PermissionError:
        _call("unshare", CLONE_NEWPID | CLONE_NEWNS | CLONE_NEWUSER)
        for name, words in (
            ("setgroups", "deny"),
            ("uid_map", f"{user} {user} 1"),
            ("gid_map", f"{own_group} {own_group} 1"),
        ):
            with open(f"/proc/self/{name}", "w", encoding="ascii") as file:
                file.write(words)


def begin_namespaces(memory_bytes: int) -> int:
    """Become the first process of the namespaces, which ends with its parent; return 0 in the child that runs the program."""
    _call("prctl", PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    _call("mount", None, b"/", None, MS_REC | MS_SLAVE, None)
    _call("mount", b"proc", b"/proc", b"proc", MS_NOSUID | MS_NODEV | MS_NOEXEC, None)
    _call("mount", b"tmpfs", bytes(FOLDER), b"tmpfs", MS_NOSUID | MS_NODEV, f"mode=1777,size={memory_bytes}".encode())
    return os.fork()


def _call(name: str, *words: int | bytes | None) -> None:
    """Call a function of the C library; raise OSError."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*words):
        problem = ctypes.get_errno()
        raise OSError(problem, f"{name}: {os.strerror(problem)}")
