"""Work on many applications that processes share, for the commands that look at all of them."""

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

from fogspec.base.workers import processes
from fogspec.language.loader import LoadedSpec, load

PER_WORKER = 10  # applications from which on a process is worth starting: it takes as long as several of them

T = TypeVar("T")
Job = Callable[[Sequence[LoadedSpec]], list[T]]


def share(job: Job[T], loaded: Sequence[LoadedSpec], workers: int | None) -> list[T]:
    """Return what `job` returns, one for each of these applications, by so many processes, or as many as are worth it.

    Job, results and errors pass between processes. Each process reads the specs of its applications; raise the errors of the
    job.
    """
    workers = min(workers or min(os.cpu_count() or 1, len(loaded) // PER_WORKER), len(loaded))
    if workers <= 1:
        return job(loaded)
    found: list[T | None] = [None] * len(loaded)
    with processes(workers) as pool:
        # By turns: those of one file, which are alike, are shared out.
        parts = [[(one.path, one.name) for one in loaded[first::workers]] for first in range(workers)]
        for first, part in enumerate(pool.map(partial(_part, job), parts)):
            found[first::workers] = part
    return [one for one in found if one is not None]


def _part(job: Job[T], applications: Sequence[tuple[str, str]]) -> list[T]:
    """Return what the job returns for these applications: the path of a spec, and the name."""
    known = {(one.path, one.name): one for one in load(list(dict.fromkeys(path for path, _ in applications)))}
    return job([known[one] for one in applications])
