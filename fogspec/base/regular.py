"""Reading what a user names: a file, and nothing that would keep whoever reads it waiting."""

import errno
import gzip
import os
import stat
import zlib
from typing import BinaryIO

from fogspec.base.file_kinds import not_a_file


def check_file(path: str | os.PathLike[str]) -> None:
    """Raises OSError, which says why, for what is no file or is not there."""
    if (what := not_a_file(os.stat(path).st_mode)) is not None:
        raise OSError(errno.EINVAL, what, os.fspath(path))


def read_file(path: str | os.PathLike[str], most_bytes: int = -1) -> bytes:
    """Its bytes, at most so many of them; raises OSError as `check_file` does, and where it cannot be read."""
    check_file(path)
    with open(path, "rb") as file:
        return file.read(most_bytes)


def decompress(content: bytes, path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file, decompressed if its name ends in `.gz`; raises OSError if it is damaged."""
    try:
        return gzip.decompress(content) if os.fspath(path).endswith(".gz") else content
    except (OSError, EOFError, zlib.error):
        raise OSError(errno.EINVAL, "it is no whole gzip file", os.fspath(path)) from None


def open_untrusted(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a file that came from a sample; raise OSError unless it is a plain file: links lead elsewhere, pipes block."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a plain file", os.fspath(path))
    return os.fdopen(descriptor, "rb")
