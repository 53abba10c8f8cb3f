"""Processes that share the work of a command: as many as asked, each with one thread for numerical libraries."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fogspec.base import child

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
OWN = {*ONE_THREAD, *child.SEARCHED, "PYTHONSAFEPATH"}


@contextmanager
def processes(
    workers: int, start: Callable[..., None] | None = None, arguments: tuple[Any, ...] = ()
) -> "Iterator[ProcessPoolExecutor]":
    """Give the processes; each calls `start` with the arguments first, and ends when this process has ended, however it did."""
    # Few commands share work, and every command would wait for these.
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with _environment(), ProcessPoolExecutor(workers, get_context("spawn"), _begin, (start, arguments)) as pool:
        yield pool


def _begin(start: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if start is not None:
        start(*arguments)


def _end_with_parent() -> None:
    from multiprocessing import parent_process

    # A worker waits in a pipe that it holds open itself: it would not notice that a parent was killed.
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)


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
