"""Applies that are killed, starved of disk or lied to about the time: what is left of them afterwards.

    python -m tests.faults.deployments [RUNS]

runs the whole life of a deployment on this host RUNS times (50), each with a fault of its own, and prints what was left
after `down`: processes, files of live state, cgroups; and how long it took from apply to the first answered request.
"""

import contextlib
import errno
import itertools
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from fogspec.backends.local import limits
from fogspec.backends.local.backend import LocalDeployments
from fogspec.backends.protocol import Job, Unreachable
from fogspec.base import files, project_files
from fogspec.deploy import state
from tests.support.deployed import MANIFEST, Deployed
from tests.support.forking import forked

# What is done in order, and after or before which a process may die.
STEPS: tuple[tuple[object, str], ...] = (
    (files.os, "replace"),
    *((state.DeploymentState, name) for name in ("_write", "keep_manifest", "gone", "clear")),
    *((LocalDeployments, name) for name in ("start", "poll", "stop")),
)
Fault = Callable[[], None]


@dataclass(frozen=True)
class Left:
    """What is there though nothing should be."""

    processes: list[int]
    files: list[str]
    cgroups: list[str]

    @property
    def nothing(self) -> bool:
        return not (self.processes or self.files or self.cgroups)


def left(deployed: Deployed) -> Left:
    """What a deployment has left; of cgroups, those that commands of `run` made."""
    made = _made(deployed).read_text().split() if _made(deployed).exists() else []
    return Left(deployed.alive(), deployed.left(), [str(group) for name in made for group in limits.groups(name)])


def _made(deployed: Deployed) -> Path:
    return deployed.folder.with_name(f"{deployed.folder.name}.cgroups")


def run(deployed: Deployed, *words: str, fault: Fault | None = None) -> int:
    """A command in a process of its own, with a fault put into it; its exit code, negative for a signal."""

    def first() -> None:
        make = limits._new_group

        def noted(name: str, limit_bytes: int) -> tuple[Path | None, bool]:
            with open(_made(deployed), "a") as file:
                file.write(f"{name}\n")
            return make(name, limit_bytes)

        limits._new_group = noted
        if fault is not None:
            fault()

    return forked(deployed.folder, words, first=first).returncode


def killed(at: int, before: bool) -> Fault:
    """The process is killed with -9 just before or after its `at`-th step."""

    def put() -> None:
        count = itertools.count(1)

        def wrapped(step: Callable[..., object]) -> Callable[..., object]:
            def call(*words: object, **named: object) -> object:
                mine = next(count) == at
                if mine and before:
                    os.kill(os.getpid(), signal.SIGKILL)
                value = step(*words, **named)
                if mine:
                    os.kill(os.getpid(), signal.SIGKILL)
                return value

            return call

        for kind, name in STEPS:
            setattr(kind, name, wrapped(getattr(kind, name)))

    return put


def full(after: int) -> Fault:
    """The disk is full from the `after`-th file on."""

    def put() -> None:
        count, replace = itertools.count(1), project_files._replace

        def full_replace(folder: int, name: str, content: bytes) -> None:
            if next(count) >= after:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            replace(folder, name, content)

        project_files._replace = full_replace

    return put


def jumped(days: int) -> Fault:
    """The date is another one, every time it is asked for."""

    def put() -> None:
        true, count = state.SystemWallClock.date, itertools.count(1)
        state.SystemWallClock.date = lambda self: true(self) + timedelta(days=days * next(count))  # type: ignore[method-assign]

    return put


def cut(polls: int, stops: int) -> Fault:
    """The network is cut: the first polls and stops reach nobody."""

    def put() -> None:
        for name, count in (("poll", polls), ("stop", stops)):
            left, step = itertools.count(1), getattr(LocalDeployments, name)

            def call(self: LocalDeployments, job: Job, left=left, step=step, count=count) -> object:  # type: ignore[no-untyped-def]
                if next(left) <= count:
                    raise Unreachable("the network is down")
                return step(self, job)

            setattr(LocalDeployments, name, call)

    return put


def orphaned(deployed: Deployed) -> None:
    """Kill the supervisor alone: its launcher ends the nodes, as soon as it notices."""
    for pid in deployed.alive():
        with contextlib.suppress(OSError):
            if b"agent.pyz\0supervisor" in Path("/proc", str(pid), "cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)


def faults(chance: random.Random) -> Iterator[tuple[str, Fault | None]]:
    """One fault after the other, without end."""
    while True:
        at, before = chance.randint(1, 14), chance.random() < 0.5
        yield f"kill -9 {'before' if before else 'after'} step {at}", killed(at, before)
        yield "the disk is full", full(chance.randint(1, 4))
        yield "kill -9 after", killed(at, False)
        yield "the clock jumps", jumped(chance.choice([-400, 400]))
        yield "the network is cut", cut(chance.randint(0, 9), chance.randint(0, 2))
        yield "the supervisor is killed", None


def life(deployed: Deployed, chance: random.Random, fault: Fault | None) -> float | None:
    """Apply with a fault, then whatever a user does next, then down; seconds from apply to the first answer, if one came."""
    begun = time.monotonic()
    code = run(deployed, "apply", MANIFEST, "--yes", fault=fault)
    took = time.monotonic() - begun if code == 0 and fault is None else None
    if fault is None:
        orphaned(deployed)
    for _ in range(chance.randint(0, 2)):
        words = chance.choice([("apply", MANIFEST, "--yes"), ("status",), ("down", "tiny")])
        run(deployed, *words, fault=fault if chance.random() < 0.3 else None)
    assert run(deployed, "down", "tiny") == 0
    return took


def main(runs: int) -> int:
    """Print the figures; exit code 1 when anything was left."""
    chance, waits, bad = random.Random(0), list[float](), 0
    with tempfile.TemporaryDirectory(prefix="fogspec-faults-") as scratch:
        deployed = Deployed.made(Path(scratch) / "app")
        waits += [_answer(deployed) for _ in range(5)]
        for number, (name, fault) in enumerate(itertools.islice(faults(chance), runs), 1):
            life(deployed, chance, fault)
            after = left(deployed)
            bad += not after.nothing
            if not after.nothing:
                print(f"run {number}, {name}: left {after}")
    print(f"after {runs} runs with faults: {bad} left anything (processes, files of live state, cgroups)")
    print(f"from apply to the first answer: median {statistics.median(waits):.2f} s (min {min(waits):.2f}, "
          f"max {max(waits):.2f}, {len(waits)} runs, whole process, nodes that answer at once)")  # fmt: skip
    return 1 if bad else 0


def _answer(deployed: Deployed) -> float:
    """Seconds of a whole process, from its start to its end, with nodes that answer at once."""
    begun = time.monotonic()
    subprocess.run(deployed.command("apply", MANIFEST, "--yes"), cwd=deployed.folder, check=True, capture_output=True)
    took = time.monotonic() - begun
    deployed("down", "tiny")
    return took


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 50))
