"""Running a stranger's program for its answer: in a child process that can read a few directories, and do nothing else.

`ask` starts an isolated interpreter with an empty environment, which imports a module of fogspec. For each question it forks,
closes the sandbox around the new process, and calls the module's `answer(question)`. Closed, the process reads below the named
directories and the system's libraries and writes small files into a scratch directory. The kernel refuses it everything
else: Landlock refuses other files, seccomp every system call that such a reader does not need (processes, sockets,
signals, modes, owners). Neither is enough alone. Limits bound CPU time, memory and files; this process bounds wall
time, scratch and answer. What remains: `stat` shows that a file exists, and its size.

The answer comes from the stranger's program and may be forged: check it like any input.
"""

import ctypes
import importlib
import json
import os
import platform
import resource
import selectors
import signal
import struct
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

from fogspec.base import child

WALL_SECONDS = 30.0
MOST_ANSWER = 8 << 20
MOST_SCRATCH = 16 << 20
LIMITS = {
    resource.RLIMIT_CPU: 4, resource.RLIMIT_AS: 1 << 30, resource.RLIMIT_FSIZE: 1 << 20, resource.RLIMIT_NOFILE: 64,
    resource.RLIMIT_CORE: 0,
}  # fmt: skip
LIBRARIES = ("/lib", "/lib64", "/usr/lib", "/usr/local/lib")
ANSWERED, REFUSED = b"A", b"R"

# System calls of x86-64 that an interpreter needs to read, compute and write a small file. No other processor was tried.
X86_64 = 0xC000003E
ALLOWED = (
    0, 1, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 17, 18, 19, 20, 21, 23, 24, 25, 28, 32, 33, 35,  # files, memory, sleep
    39, 60, 63, 77, 78, 79, 82, 83, 84, 87, 89, 96, 97, 98, 99, 102, 104, 107, 108, 110, 186, 201, 202,  # scratch, own identity
    217, 228, 229, 230, 231, 258, 262, 263, 264, 267, 269, 270, 271, 292, 316, 318, 332, 334, 439,
)  # fmt: skip
OPEN, OPENAT, FCNTL, IOCTL = 2, 257, 72, 16
TRUNCATES_READ_ONLY = (0o1003, 0o1000)  # O_TRUNC without write access: old versions of Landlock let it pass
DESCRIPTORS = (0, 1, 2, 3, 1030)  # fcntl on descriptors alone: no locks, and no signals to an owner
CLOSED_ON_EXEC = (0x5451,)  # the one ioctl that Python needs, for a file that an opener opens
LOAD, AND, EQUAL, RETURN = 0x20, 0x54, 0x15, 0x06
LET, DENY, KILL = 0x7FFF0000, 0x00050001, 0x80000000


class SandboxError(Exception):
    """The sandboxed program gave no answer, or the machine has no sandbox: the reason."""


def ask(module: str, questions: Sequence[Any], readable: Sequence[str], *, trusted: bool = False) -> list[bytes]:
    """Return the JSON that `answer(question)` of a module gives in a sandbox, for each; raise SandboxError if it gives none.

    It can read the files in `readable`, and those below its directories. `trusted` runs it also where the machine lacks a
    layer of the sandbox. Each question is answered by a process of its own, which knows nothing of the others.
    """
    with tempfile.TemporaryDirectory() as scratch:
        scratch = os.path.realpath(scratch)
        asked = {"questions": list(questions), "readable": list(readable), "scratch": scratch, "trusted": trusted}
        # -I would ignore the seed of hashes, and the order of sets is part of an answer; the environment is otherwise empty.
        words = ["-P", "-s", "-B", *child.python("fogspec.base.sandbox", module)[2:]]
        with subprocess.Popen(
            [sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env={"PYTHONHASHSEED": "0"}, cwd=scratch, start_new_session=True,
        ) as process:  # fmt: skip
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                with suppress(BrokenPipeError):
                    process.stdin.write(json.dumps(asked).encode())
                    process.stdin.flush()
                with suppress(BrokenPipeError):
                    process.stdin.close()
                answer = _bounded(process.stdout.fileno(), scratch)
                ended = process.wait(WALL_SECONDS)
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
    lines = answer.split(b"\n")[:-1]
    if len(lines) == len(questions) and all(line[:1] == ANSWERED for line in lines):
        return [line[1:] for line in lines]
    if answer[:1] == REFUSED:
        raise SandboxError(lines[0][1:].decode("utf-8", "replace"))
    if ended in (signal.SIGXCPU, signal.SIGKILL):
        raise SandboxError(f"it takes more than {LIMITS[resource.RLIMIT_CPU]} s of processor time")
    raise SandboxError("it ended its process without an answer")


def _bounded(pipe: int, scratch: str) -> bytes:
    """Return what comes through the pipe; raise SandboxError if it is too much or takes too long, or the scratch is full."""
    found: list[bytes] = []
    end, size = time.monotonic() + WALL_SECONDS, 0
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        while True:
            if time.monotonic() > end:
                raise SandboxError(f"it takes longer than {WALL_SECONDS:g} s")
            if selector.select(0.05):
                part = os.read(pipe, 1 << 16)
                if not part:
                    return b"".join(found)
                found.append(part)
                size += len(part)
            if size > MOST_ANSWER:
                raise SandboxError(f"its answer is larger than {MOST_ANSWER >> 20} MiB")
            if _size(scratch) > MOST_SCRATCH:
                raise SandboxError(f"it writes more than {MOST_SCRATCH >> 20} MiB")


def _size(folder: str) -> int:
    size = 0
    for at, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                size += os.lstat(os.path.join(at, name)).st_size
    return size


# Inside the process.


def close(readable: Sequence[str], scratch: str) -> list[str]:
    """Close the sandbox around this process, for good; return what this machine lacks for it."""
    lacks = []
    for kind, most in LIMITS.items():
        resource.setrlimit(kind, (most, most))
    if sys.platform != "linux":
        return [f"a sandbox for processes (this is {sys.platform})"]
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(38, 1, 0, 0, 0)  # PR_SET_NO_NEW_PRIVS
    if not _landlock(libc, readable, scratch):
        lacks.append("Landlock (Linux 5.13 or newer)")
    if platform.machine() != "x86_64":
        lacks.append(f"a list of system calls for {platform.machine()} (there is one for x86_64)")
    elif not _seccomp(libc):
        lacks.append("seccomp")
    return lacks


def _landlock(libc: ctypes.CDLL, readable: Sequence[str], scratch: str) -> bool:
    """Refuse files but those below some directories, TCP, and signals to others."""
    version = libc.syscall(444, None, 0, 1)
    if version < 1:
        return False
    newer = (version >= 2) << 13 | (version >= 3) << 14 | (version >= 5) << 15
    rights = struct.pack("QQQ", (1 << 13) - 1 | newer, 3 * (version >= 4), 3 * (version >= 6))
    rights = rights[: 8 if version < 4 else 16 if version < 6 else 24]
    rules = libc.syscall(444, rights, len(rights), 0)
    read, write = 1 << 2 | 1 << 3, 1 << 1 | 1 << 4 | 1 << 5 | 1 << 7 | 1 << 8 | (version >= 3) << 14
    for folder, access in [*((one, read) for one in readable), (scratch, read | write)]:
        with suppress(OSError):  # what this user cannot open needs no rule
            at = os.open(folder, os.O_PATH | os.O_CLOEXEC)
            access &= ~0 if os.path.isdir(folder) else 1 << 2  # of a file, only reading it has a meaning
            failed = libc.syscall(445, rules, 1, struct.pack("<Qi", access, at), 0)
            os.close(at)
            if failed:
                return False
    done: bool = rules >= 0 and libc.syscall(446, rules, 0) == 0
    os.close(rules)
    return done


def _seccomp(libc: ctypes.CDLL) -> bool:
    """Let the listed system calls pass, and refuse all others with EPERM."""
    program = [
        (LOAD, 0, 0, 4), (EQUAL, 1, 0, X86_64), (RETURN, 0, 0, KILL), (LOAD, 0, 0, 0),
        *_judged(FCNTL, 1, 0xFFFFFFFF, DESCRIPTORS, LET, DENY),
        *_judged(IOCTL, 1, 0xFFFFFFFF, CLOSED_ON_EXEC, LET, DENY),
        *_judged(OPEN, 1, *_truncates(), DENY, LET),
        *_judged(OPENAT, 2, *_truncates(), DENY, LET),
        *((EQUAL, len(ALLOWED) - i, 0, number) for i, number in enumerate(ALLOWED)),
        (RETURN, 0, 0, DENY), (RETURN, 0, 0, LET),
    ]  # fmt: skip
    code = b"".join(struct.pack("HBBI", *one) for one in program)
    kept = ctypes.create_string_buffer(code, len(code))
    filters = struct.pack("HxxxxxxQ", len(program), ctypes.addressof(kept))
    return bool(libc.prctl(22, 2, filters, 0, 0) == 0)  # PR_SET_SECCOMP, SECCOMP_MODE_FILTER


def _truncates() -> tuple[int, tuple[int, ...]]:
    mask, value = TRUNCATES_READ_ONLY
    return mask, (value,)


def _judged(
    number: int, argument: int, mask: int, values: tuple[int, ...], matched: int, other: int
) -> list[tuple[int, int, int, int]]:
    """Return instructions that decide one system call by an argument."""
    tests = [(EQUAL, len(values) - i, 0, value) for i, value in enumerate(values)]
    some = [(LOAD, 0, 0, 16 + 8 * argument), (AND, 0, 0, mask), *tests, (RETURN, 0, 0, other), (RETURN, 0, 0, matched)]
    return [(EQUAL, 0, len(some), number), *some]


def system_folders() -> list[str]:
    """Return the directories of this interpreter's library, of its packages and of the system's libraries."""
    found = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    found += [os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))) + "/fogspec", *LIBRARIES]
    return sorted({os.path.realpath(one) for one in found if os.path.isdir(one)})


def run(module: str) -> NoReturn:
    """Read the questions, and have each answered by a sandboxed process; end by the number of the signal that ends one."""
    asked = json.loads(sys.stdin.buffer.read())
    pipe = os.dup(1)
    answer = importlib.import_module(module).answer
    with open(os.devnull, "r+b", buffering=0) as null:
        for number in (0, 1, 2):
            os.dup2(null.fileno(), number)
    for number, question in enumerate(asked["questions"]):
        scratch = f"{asked['scratch']}/{number}"
        os.mkdir(scratch)
        sandboxed = os.fork()
        if sandboxed == 0:
            os.chdir(scratch)
            lacks = close([*asked["readable"], *system_folders()], scratch)
            if lacks and not asked["trusted"]:
                _write(pipe, REFUSED + f"this machine lacks {' and '.join(lacks)}".encode())
            _write(pipe, ANSWERED + json.dumps(answer(question | {"scratch": scratch})).encode())
        ended = os.waitpid(sandboxed, 0)[1]
        os.write(pipe, b"\n")
        if ended:
            os._exit(os.WTERMSIG(ended) if os.WIFSIGNALED(ended) else 1)
    os._exit(0)


def _write(pipe: int, content: bytes) -> NoReturn:
    while content:
        content = content[os.write(pipe, content) :]
    os._exit(0)


if __name__ == "__main__":
    run(sys.argv[1])
