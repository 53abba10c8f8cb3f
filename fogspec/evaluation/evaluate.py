"""Replaying a suite in a few processes; the same numbers however many there are."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from fogspec.evaluation.running import Campaign, Ended, run
from fogspec.evaluation.suite import Suite
from fogspec.evaluation.suites import read_suite
from fogspec.model.priors import read_priors
from fogspec.numerics.priors import Library

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass
class _World:
    """What each process reads once."""

    suite: Suite
    library: Library | None


_world: _World | None = None


def evaluate(
    suite: Path, priors: Path | None, kinds: Sequence[str], campaigns: Sequence[Campaign], *, workers: int = 2
) -> tuple[list[list[Ended]], str]:
    """For each campaign what became of every problem of these kinds (all if none), and the priors' digest or ''.

    Raises DiagnosticError and InvalidInput for what is wrong with the files. Linear algebra runs in one thread a process:
    two processes of two threads are slower than two of one, and sums would depend on the machine.
    """
    read, library = read_suite(suite), read_priors(priors) if priors else None
    wanted = [i for i, problem in enumerate(read.problems) if not kinds or problem.kind in kinds]
    # The longest first: the other process does not wait for one at the end.
    order = sorted(wanted, key=lambda i: -len(read.problems[i].rows))
    jobs = [(campaign, i) for campaign in campaigns for i in order]
    with _one_thread(), ProcessPoolExecutor(workers, get_context("spawn"), _start, (suite, priors)) as pool:
        found = dict(zip(jobs, pool.map(_one, *zip(*jobs, strict=True)), strict=True)) if jobs else {}
    done = [[one for i in wanted for one in found[campaign, i]] for campaign in campaigns]
    return done, library.digest if library else ""


def _start(suite: Path, priors: Path | None) -> None:
    global _world
    _world = _World(read_suite(suite), read_priors(priors) if priors else None)


def _one(campaign: Campaign, index: int) -> list[Ended]:
    assert _world is not None
    return run(_world.suite.problems[index], _world.suite.table, _world.library, campaign)


@contextmanager
def _one_thread() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
