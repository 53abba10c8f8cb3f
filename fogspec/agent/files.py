"""Files beside a workload, which may put a link, a pipe or a device in the place of each: only plain files are opened."""

import contextlib
import errno
import os
import stat
from pathlib import Path

PLAIN = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


def open_plain(path: "str | os.PathLike[str]", flags: int = os.O_RDONLY) -> int:
    """Open a plain file, without waiting for its other end; raise OSError for anything else."""
    descriptor = os.open(path, flags | PLAIN, 0o644)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a plain file", os.fspath(path))
    return descriptor


def read_tail(path: Path, limit: int) -> bytes:
    """Return at most `limit` bytes from the end of a file; nothing if there is none."""
    with contextlib.suppress(OSError), open(open_plain(path), "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - limit))
        return file.read(limit)
    return b""


def truncate(path: Path, size: int) -> None:
    """Cut a file to at most `size` bytes; ignore one that cannot be."""
    with contextlib.suppress(OSError), open(open_plain(path, os.O_RDWR), "r+b") as file:
        file.truncate(min(size, os.fstat(file.fileno()).st_size))


def write_new(path: Path, text: str) -> None:
    """Write a file that replaces whatever had its name; raise OSError."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
    with open(open_plain(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "w", encoding="utf-8") as file:
        file.write(text)
