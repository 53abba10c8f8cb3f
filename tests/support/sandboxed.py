"""Sandboxes that begin with their reader loaded, for tests of what launch files say: starting one is most of its time.

A process that has the reader waits for questions, and forks for each; the sandbox closes in the fork as it always does. What
starting does, and what the sandbox keeps out, is for `tests/unit/base/test_sandbox.py`.
"""

import array
import atexit
import contextlib
import functools
import json
import os
import socket
import subprocess
import sys
import types
from typing import Any

import pytest

from fogspec.base import child, sandbox

WAITING = "tests.support.waiting_sandbox"


class Sandbox:
    """Stands for the process that `sandbox.ask` starts."""

    def __init__(self, module: str, folder: str) -> None:
        self._socket = _waiting(module)
        (question, ours), (answer, theirs) = os.pipe(), os.pipe()
        self.stdin, self.stdout = open(ours, "wb"), open(answer, "rb", 0)  # noqa: SIM115
        said = json.dumps([folder, sandbox.LIMITS]).encode()
        passed = array.array("i", [question, theirs])
        self._socket.sendmsg([said], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, passed)])
        for file in passed:
            os.close(file)
        self.pid = int.from_bytes(self._socket.recv(8), "big")
        self._code: int | None = None

    def wait(self, timeout: float | None = None) -> int:
        if self._code is None:
            self._code = int.from_bytes(self._socket.recv(8), "big", signed=True)
        return self._code

    def __enter__(self) -> "Sandbox":
        return self

    def __exit__(self, *_: object) -> None:
        self.stdout.close()
        with contextlib.suppress(BrokenPipeError):
            self.stdin.close()
        self.wait()


def started(words: list[str], **options: Any) -> "Sandbox | subprocess.Popen[bytes]":
    """What the waiting process forks; a process of its own for a program that a test put in the place of the sandbox."""
    if sandbox.__name__ in words:
        return Sandbox(words[-1], options["cwd"])
    return subprocess.Popen(words, **options)


@functools.cache
def _waiting(module: str) -> socket.socket:
    """Start the process that waits, as a sandbox is started; it ends with this one."""
    ours, theirs = socket.socketpair()
    words = ["-P", "-s", "-B", *child.python(WAITING, str(theirs.fileno()), module)[2:]]
    waiting = subprocess.Popen(
        [sys.executable, *words], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={"PYTHONHASHSEED": "0"}, cwd="/", start_new_session=True, pass_fds=[theirs.fileno()],
    )  # fmt: skip
    theirs.close()
    atexit.register(waiting.wait)
    atexit.register(ours.close)  # before it
    return ours


@pytest.fixture(autouse=True)
def loaded_sandbox(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each sandbox of the module that imports this begins with its reader loaded."""
    stands = types.SimpleNamespace(Popen=started, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL)
    monkeypatch.setattr(sandbox, "subprocess", stands)
