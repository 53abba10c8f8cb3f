"""Folders that many tests begin with, each made once for all workers of a session."""

import atexit
import fcntl
import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

SESSION = "FOGSPEC_TEST_SESSION"  # the session's folder, which tests/conftest.py makes and removes


def once(key: str, fill: Callable[[Path], None]) -> Path:
    """Return the folder that `fill` makes; it is the same for the same key, and to be copied."""
    folder = _session() / hashlib.sha256(key.encode()).hexdigest()[:16]
    with open(folder.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            unfinished = folder.with_suffix(".new")
            shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir()
            fill(unfinished)
            unfinished.rename(folder)
    return folder


@functools.cache
def _session() -> Path:
    if SESSION in os.environ:
        return Path(os.environ[SESSION])
    folder = tempfile.mkdtemp(prefix="fogspec-once-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
