"""Processes that share the work of a command: as many as asked, each with one thread for numerical libraries."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from fogspec.base import child

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
OWN = {*ONE_THREAD, *child.SEARCHED, "PYTHONSAFEPATH"}


@contextmanager
def processes(
    workers: int, start: Callable[..., None] | None = None, arguments: tuple[Any, ...] = ()
) -> Iterator[ProcessPoolExecutor]:
    """Give the processes; each calls `start` with the arguments first."""
    with _environment(), ProcessPoolExecutor(workers, get_context("spawn"), start, arguments) as pool:
        yield pool


@contextmanager
def _environment() -> Iterator[None]:
    # The interpreters are started by the standard library: PYTHONSAFEPATH keeps the working folder out of them.
    own = {name: value for name, value in child.environment(**ONE_THREAD, PYTHONSAFEPATH="1").items() if name in OWN}
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
