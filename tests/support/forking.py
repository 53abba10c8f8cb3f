"""The command line in a process of its own that need not load everything again."""

import contextlib
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np  # noqa: F401 -- what every command loads is loaded once, here
import scipy.stats  # noqa: F401

from fogspec.cli import VERBS, fogspec, main


@dataclass(frozen=True)
class Ended:
    """How a command ended; a code below 0 is the signal that ended it."""

    returncode: int
    stdout: str
    stderr: str


def forked(
    folder: Path, words: Sequence[str], env: Mapping[str, str] | None = None, first: Callable[[], None] | None = None,
    patience_s: float = 120.0,
) -> Ended:  # fmt: skip
    """Run a command in `folder` with nothing to read, after `first` was called in its process."""
    for verb in VERBS:
        fogspec.get_command(None, verb)  # type: ignore[arg-type]
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        child = os.fork()
        if child == 0:
            _become(folder, words, env or {}, first, out.fileno(), err.fileno())
        code = _wait(child, patience_s)
        said = []
        for file in (out, err):
            file.seek(0)
            said.append(file.read())
    return Ended(code, *said)


def _become(
    folder: Path, words: Sequence[str], env: Mapping[str, str], first: Callable[[], None] | None, out: int, err: int
) -> None:
    code = 1
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(out, 1)
        os.dup2(err, 2)
        # Whoever captures output in the parent has put its own in their place.
        sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w"), open(2, "w")  # noqa: SIM115
        os.setsid()
        os.chdir(folder)
        os.environ.update(env)
        if first is not None:
            first()
        main(list(words))
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _wait(child: int, patience_s: float) -> int:
    end = time.monotonic() + patience_s
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise AssertionError(f"it did not end within {patience_s:g} s")
        time.sleep(0.01)
