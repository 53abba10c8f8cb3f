"""The command line in a process of its own that need not load everything again."""

import contextlib
import functools
import gc
import importlib
import os
import pkgutil
import select
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import scipy.stats  # noqa: F401 -- what every command loads is loaded once, here
from pydantic import BaseModel

import fogspec as package
import fogspec_lab
from fogspec.base import templates
from fogspec.cli import VERBS, fogspec, main

# On machines, in ROS 2's Python and in SkyPilot's process these are loaded apart from the command line.
APART = ("fogspec.agent", "fogspec.ros", "fogspec.backends.skypilot")


@dataclass(frozen=True)
class Ended:
    """How a command ended, and what it took; a code below 0 is the signal that ended it."""

    returncode: int
    stdout: str
    stderr: str
    cpu_s: float
    memory_mib: int


def forked(
    folder: Path, words: Sequence[str], env: Mapping[str, str] | None = None, first: Callable[[], None] | None = None,
    patience_s: float = 1200.0, run: Callable[[list[str]], None] = main,
) -> Ended:  # fmt: skip
    """Run a command in `folder` with nothing to read, after `first` was called in its process; `run` is the program."""
    load()
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        child = os.fork()
        if child == 0:
            os.environ.update(env or {})
            become(
                folder, lambda: run(list(words)), (os.open(os.devnull, os.O_RDONLY), out.fileno(), err.fileno()), first
            )
        code, cpu_s, memory_mib = _wait(child, patience_s)
        said = []
        for file in (out, err):
            file.seek(0)
            said.append(file.read())
    return Ended(code, *said, cpu_s, memory_mib)


@functools.cache
def load() -> None:
    """Load what verbs load when they are called, build their models and compile their templates: six sevenths of their time."""
    for one in (package, fogspec_lab):
        for module in pkgutil.walk_packages(one.__path__, f"{one.__name__}."):
            if not module.name.startswith(APART) and not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    for verb in VERBS:
        fogspec.get_command(None, verb)  # type: ignore[arg-type]
    waiting: list[type[BaseModel]] = [BaseModel]
    while waiting:
        waiting += (model := waiting.pop()).__subclasses__()
        if model.__module__.startswith("fogspec"):
            model.model_rebuild()
    environment = templates._environment()
    for name in environment.list_templates():
        environment.get_template(name)


def become(
    folder: Path, run: Callable[[], None], files: Sequence[int], first: Callable[[], None] | None = None
) -> NoReturn:
    """Be a process of its own that runs in `folder` with these files as its standard ones; `first` is called before."""
    code = 1
    gc.freeze()  # what is shared with the parent is not copied for a mark of the garbage collector
    gc.set_threshold(200_000)  # as where fogspec starts
    try:
        for number, file in enumerate(files):
            os.dup2(file, number)
        # Whoever captures output in the parent has put its own in their place.
        sys.stdin, sys.stdout = open(0), open(1, "w")  # noqa: SIM115
        sys.stderr = open(2, "w", buffering=1, errors="backslashreplace")  # noqa: SIM115
        os.setsid()
        os.chdir(folder)
        if first is not None:
            first()
        run()
        code = 0
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _wait(child: int, patience_s: float) -> tuple[int, float, int]:
    ended = os.pidfd_open(child)
    try:
        if not select.select([ended], [], [], patience_s)[0]:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise AssertionError(f"it did not end within {patience_s:g} s")
    finally:
        os.close(ended)
    _, status, used = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss >> 10
