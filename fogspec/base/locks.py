"""One bench, apply or down of an application at a time: a lock that the kernel drops with the process that held it."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

from fogspec.base.errors import Busy, InvalidInput
from fogspec.base.files import not_a_file
from fogspec.base.git import check_untracked
from fogspec.base.layout import Layout

MOST_BYTES = 4096


def start_ticks(pid: int) -> int | None:
    """Return when a living process was started, in clock ticks since boot; None if there is no such process.

    Together with the pid this identifies a process, since pids are reused.
    """
    try:
        fields = Path("/proc", str(pid), "stat").read_bytes().rsplit(b")", 1)[1].split()
    except (OSError, IndexError):
        return None
    return None if fields[0] in (b"Z", b"X") else int(fields[19])


@contextlib.contextmanager
def application_lock(layout: Layout, what: str, remove: bool = False, tracked: bool = False) -> Iterator[None]:
    """Hold an application's lock for `what`; raise Busy, naming the holder, if another process has it.

    Raises InvalidInput for what is not a file, and Refused for state that git tracks unless it may be `tracked`.

    What stands in the file is for people; the kernel's lock decides, so that a holder that was killed leaves nothing
    to clean up. With `remove` the file goes when it is over; if it was removed meanwhile, a new one is locked.
    """
    import fcntl  # of POSIX only; commands that only read the state import this module too

    if not tracked:
        check_untracked(layout)
    path, files = layout.application_lock, layout.files
    if (found := files.stat(path)) is not None and (kind := not_a_file(found.st_mode)) is not None:
        raise InvalidInput(f"{path}: {kind}", "remove it")
    with contextlib.ExitStack() as opened:
        while True:
            file = opened.enter_context(files.append(path))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                hint = "wait for it, or stop it with Ctrl-C there"
                raise Busy(f"{what} must wait: {_holder(layout)} has not ended", hint) from None
            if (now := files.stat(path)) is not None and os.path.samestat(os.fstat(file.fileno()), now):
                break
        holder = {
            "what": what,
            "pid": os.getpid(),
            "start_ticks": start_ticks(os.getpid()),
            "host": os.uname().nodename,
        }
        file.truncate(0)
        # The lock holds even on a full disk.
        with contextlib.suppress(OSError):
            os.write(file.fileno(), json.dumps(holder).encode())
        try:
            yield
        finally:
            file.truncate(0)
            if remove:
                files.remove(path)


def _holder(layout: Layout) -> str:
    try:
        holder = json.loads(layout.files.read(layout.application_lock, MOST_BYTES))
        return f"{holder['what']} (process {holder['pid']} on {holder['host']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
