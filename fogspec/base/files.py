"""Reading files: a whole regular file, or a located refusal. `fogspec.base.project_files` writes.

Reading a pipe or a device may wait forever or never end, so that only regular files are read or written over.
"""

import errno
import io
import os
import stat
from typing import BinaryIO

KINDS = (
    (stat.S_ISDIR, "it is a folder"),
    (stat.S_ISFIFO, "it is a pipe"),
    (stat.S_ISSOCK, "it is a socket"),
    (stat.S_ISCHR, "it is a device"),
    (stat.S_ISBLK, "it is a device"),
)


# What the files of Git LFS are until they are pulled, by its specification: shorter than 1,024 bytes, with this first line.
POINTER, POINTER_BYTES = b"version https://git-lfs.github.com/spec/v1\n", 1024
PULL = "run 'git lfs pull'"


def not_a_file(mode: int) -> str | None:
    """Return why nothing can be read from what has this `st_mode`, or written over it; None for a regular file."""
    return next((f"{what}, not a file" for is_one, what in KINDS if is_one(mode)), None)


def check_file(path: str | os.PathLike[str]) -> None:
    """Raise OSError, with the reason, if the path does not exist or is not a regular file."""
    if (what := not_a_file(os.stat(path).st_mode)) is not None:
        raise OSError(errno.EINVAL, what, os.fspath(path))


def read_file(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """Return the file's bytes, at most `most_bytes` of them; raise OSError as `check_file` does or if it is unreadable."""
    check_file(path)
    with open(path, "rb") as file:
        return checked(file.read(most_bytes), path)


def checked(content: bytes, path: str | os.PathLike[str]) -> bytes:
    """Return what was read of a file; raise OSError if it is a pointer of Git LFS."""
    if content.startswith(POINTER) and len(content) < POINTER_BYTES:
        raise OSError(errno.EINVAL, f"it is a pointer of Git LFS, not the file: {PULL}", os.fspath(path))
    return content


def open_untrusted(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a file that came from a sample; raise OSError unless it is a plain file: links lead elsewhere, pipes block."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a plain file", os.fspath(path))
    return os.fdopen(descriptor, "rb")


def read_bounded(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """Return the file's bytes; raise OSError as `read_file` does, or if there are more than `most_bytes`."""
    content = read_file(path, most_bytes + 1)
    if len(content) > most_bytes:
        raise too_large(path, most_bytes)
    return content


def too_large(path: str | os.PathLike[str], most_bytes: int, how: str = "") -> OSError:
    """Return the error for a file with more than `most_bytes`."""
    return OSError(errno.EFBIG, f"it has more than {most_bytes >> 10:,} KiB{how}", os.fspath(path))


def decompress(content: bytes, path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """Return the content of a file, decompressed if its name ends in `.gz`, never more than `most_bytes`.

    Raise OSError if it is damaged or larger.
    """
    import gzip  # few files are compressed
    import zlib

    if not os.fspath(path).endswith(".gz"):
        return content
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as packed:
            found = packed.read(most_bytes + 1)
    except (OSError, EOFError, zlib.error):
        raise OSError(errno.EINVAL, "it is not a complete gzip file", os.fspath(path)) from None
    if len(found) > most_bytes:
        raise too_large(path, most_bytes, " unpacked")
    return found
