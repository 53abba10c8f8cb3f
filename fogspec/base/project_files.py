"""The one place that opens, writes, moves and removes what is fogspec's in a project: nothing outside is ever touched.

A checkout is written by others too. Each path is walked from a handle of the project's folder, and no component below that
may be a link: not the last, not one in between, also not one that appears meanwhile. The project's folder itself may be
reached through links, which are the user's own.
"""

import contextlib
import errno
import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from fogspec.base.errors import InvalidInput
from fogspec.base.files import checked, not_a_file, too_large

FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
STATE, IGNORED = ".fogspec", ".gitignore"  # the folder of live state, and what keeps it out of git
DEEPEST = 64  # folders in folders, as far as files are looked for
PLAIN = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class LinkedPath(InvalidInput):
    """A link stands where fogspec keeps a file or a folder."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(
            f"{os.fspath(path)}: it is a link, which may lead out of the project: not followed",
            "put the file or folder itself there, or remove the link",
        )


@dataclass(frozen=True, slots=True)
class ProjectFiles:
    """The files below `root`. Paths are given as `Layout` has them, with the root in front.

    Every method raises LinkedPath for a link, InvalidInput for a path outside of the root, and OSError as its namesake in `os`
    unless it says otherwise. A file is a regular file: pipes and devices, which may block, are refused as OSError.
    """

    root: Path

    def read(self, path: Path, most_bytes: int) -> bytes:
        """Return a file's bytes; raise OSError if there are more than `most_bytes`."""
        content = self.head(path, most_bytes + 1)
        if len(content) > most_bytes:
            raise too_large(path, most_bytes)
        return content

    def head(self, path: Path, most_bytes: int) -> bytes:
        """Return the first `most_bytes` bytes of a file."""
        with self.open(path) as file:
            return checked(file.read(most_bytes), path)

    def open(self, path: Path) -> BinaryIO:
        """Open a file to read it."""
        with self._at(path) as (folder, name):
            return os.fdopen(_opened(folder, name, path, os.O_RDONLY), "rb")

    def append(self, path: Path) -> BinaryIO:
        """Open a file to read it and add to it, unbuffered; it and its folders are made, and synced, if they are missing."""
        with self._at(path, make=True) as (folder, name):
            descriptor = _opened(folder, name, path, os.O_RDWR | os.O_APPEND | os.O_CREAT)
            os.fsync(folder)
            return os.fdopen(descriptor, "ab+", buffering=0)

    def create(self, path: Path) -> BinaryIO:
        """Open a file to replace it; missing directories are created."""
        with self._at(path, make=True) as (folder, name):
            return os.fdopen(_opened(folder, name, path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), "wb")

    def write(self, path: Path, content: bytes) -> None:
        """Write a file atomically and durably: to a new file beside it, synced, then renamed over it, the folder synced.

        Raise InvalidInput, naming the path, if that fails; the previous content then stays as it was.
        """
        try:
            with self._at(path, make=True) as (folder, name):
                if (kind := _kind(folder, name, path)) is not None and (what := not_a_file(kind)) is not None:
                    raise OSError(errno.EINVAL, what, os.fspath(path))
                _replace(folder, name, content)
        except OSError as problem:
            raise InvalidInput(f"{path}: cannot be written: {problem.strerror}") from None

    def write_yaml(self, path: Path, data: Mapping[str, Any], made: str) -> None:
        """Write the text of `yaml_text` to a file; see `write`."""
        from fogspec.base.yaml.writer import yaml_text  # most commands only read

        self.write(path, yaml_text(data, made).encode())

    def make_folder(self, path: Path) -> None:
        """Make a folder, and those above it; raise FileExistsError if it is there."""
        with self._at(path, make=True) as (folder, name):
            os.mkdir(name, dir_fd=folder)
            os.fsync(folder)

    def move(self, source: Path, target: Path) -> None:
        """Rename a file or folder; the folders above the target are made if they are missing."""
        with self._at(source) as (folder, name), self._at(target, make=True) as (below, new):
            _kind(folder, name, source)
            _kind(below, new, target)
            os.rename(name, new, src_dir_fd=folder, dst_dir_fd=below)
            os.fsync(below)

    def set_aside(self, source: Path, target: Path) -> None:
        """Give a file a second name, so that the first can be written over; move what can have only one."""
        try:
            with self._at(source) as (folder, name), self._at(target, make=True) as (below, new):
                _kind(below, new, target)
                if not stat.S_ISREG(_kind(folder, name, source) or 0):
                    raise OSError(errno.EINVAL, "it is not a file", os.fspath(source))
                os.link(name, new, src_dir_fd=folder, dst_dir_fd=below, follow_symlinks=False)
                os.fsync(below)
        except OSError:
            self.move(source, target)

    def remove(self, path: Path) -> bool:
        """Remove a file; return whether there was one."""
        try:
            with self._at(path) as (folder, name):
                _kind(folder, name, path)
                os.unlink(name, dir_fd=folder)
                return True
        except FileNotFoundError:
            return False

    def remove_folder(self, path: Path) -> bool:
        """Remove a folder if it is empty; return whether it is gone."""
        try:
            with self._at(path) as (folder, name):
                if name == STATE and self.names(path) == [IGNORED]:
                    self.remove(path / IGNORED)
                os.rmdir(name, dir_fd=folder)
        except FileNotFoundError:
            return True
        except OSError:
            return False
        return True

    def remove_tree(self, path: Path) -> bool:
        """Remove a folder with all that is in it; links in it are removed, not followed. Return whether there was one."""
        try:
            with self._at(path) as (folder, name):
                _kind(folder, name, path)
                _remove_tree(folder, name)
                return True
        except FileNotFoundError:
            return False

    def names(self, path: Path) -> list[str]:
        """Return the sorted names of what a folder has; none if there is no such folder."""
        try:
            with self._folder(path) as folder:
                return sorted(os.listdir(folder))
        except (FileNotFoundError, NotADirectoryError):
            return []

    def files(self, path: Path) -> Iterator[Path]:
        """Yield the files in a folder and in those below it, at most `DEEPEST` deep, without links."""
        waiting = [(path, 0)]
        while waiting:
            at, depth = waiting.pop()
            try:
                with self._folder(at) as folder:
                    kinds = {
                        name: os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode
                        for name in sorted(os.listdir(folder))
                    }
            except (OSError, LinkedPath) as problem:
                if depth or isinstance(problem, (FileNotFoundError, NotADirectoryError)):
                    continue  # it cannot be read, or is gone: what stands beside it is still of interest
                raise
            yield from (at / name for name, mode in kinds.items() if stat.S_ISREG(mode))
            if depth < DEEPEST:
                waiting += [(at / name, depth + 1) for name, mode in kinds.items() if stat.S_ISDIR(mode)]

    def stat(self, path: Path) -> os.stat_result | None:
        """Return the status of a file or folder; None if there is none."""
        try:
            with self._at(path) as (folder, name):
                _kind(folder, name, path)
                return os.stat(name, dir_fd=folder, follow_symlinks=False)
        except (FileNotFoundError, NotADirectoryError):
            return None

    def exists(self, path: Path) -> bool:
        """Return whether there is something at this path."""
        return self.stat(path) is not None

    def is_file(self, path: Path) -> bool:
        """Return whether there is a file at this path."""
        found = self.stat(path)
        return found is not None and stat.S_ISREG(found.st_mode)

    def is_folder(self, path: Path) -> bool:
        """Return whether there is a folder at this path."""
        found = self.stat(path)
        return found is not None and stat.S_ISDIR(found.st_mode)

    @contextlib.contextmanager
    def _at(self, path: Path, make: bool = False) -> Iterator[tuple[int, str]]:
        """Yield a handle of the folder that a path is in, and its name there."""
        path = Path(path)
        *_, name = self._steps(path) or [""]
        if not name:
            raise InvalidInput(f"{path}: it is the project's folder itself")
        with self._folder(path.parent, make) as folder:
            yield folder, name

    @contextlib.contextmanager
    def _folder(self, path: Path, make: bool = False) -> Iterator[int]:
        """Yield a handle of a folder, after one step for each component below the root."""
        if make:
            os.makedirs(self.root, exist_ok=True)
        here, at = os.open(self.root, FOLDER), Path(self.root)
        try:
            for step in self._steps(path):
                at /= step
                below = _stepped(here, step, at, make)
                os.close(here)
                here = below
                if make and step == STATE:
                    _ignore(here)
            yield here
        finally:
            os.close(here)

    def _steps(self, path: Path) -> list[str]:
        """Return the components of a path below the root; raise InvalidInput if it is outside."""
        inside = os.path.relpath(path, self.root)
        if inside == os.pardir or inside.startswith(os.pardir + os.sep):
            raise InvalidInput(f"{path}: it is outside of the project's folder {os.path.abspath(self.root)}")
        return [] if inside == os.curdir else inside.split(os.sep)


def write_output(path: Path, content: bytes) -> None:
    """Write a file that the user named, as `ProjectFiles.write` does.

    The folders on the way are the user's own word, links included; a link at the file itself is refused.
    """
    ProjectFiles(path.parent).write(path, content)


def _ignore(folder: int) -> None:
    """Have git ignore a folder, as far as the disk allows: what is to be written there is worth more."""
    with contextlib.suppress(OSError):
        if IGNORED not in os.listdir(folder):
            _replace(folder, IGNORED, b"*\n")


def _stepped(here: int, step: str, at: Path, make: bool) -> int:
    if make:
        with contextlib.suppress(FileExistsError):
            os.mkdir(step, dir_fd=here)
            os.fsync(here)
    try:
        return os.open(step, FOLDER | os.O_NOFOLLOW, dir_fd=here)
    except OSError as problem:
        _kind(here, step, at)
        raise OSError(problem.errno, problem.strerror, str(at)) from None


def _kind(folder: int, name: str, path: Path) -> int | None:
    """Return the `st_mode` of what a folder has by this name, None for nothing; raise LinkedPath for a link."""
    try:
        mode = os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISLNK(mode):
        raise LinkedPath(path)
    return mode


def _opened(folder: int, name: str, path: Path, flags: int) -> int:
    """Open a file, which is neither a link nor anything else that only looks like one."""
    mode = _kind(folder, name, path)
    if mode is not None and (what := not_a_file(mode)) is not None:
        raise OSError(errno.EINVAL, what, os.fspath(path))
    try:
        descriptor = os.open(name, flags | PLAIN, 0o666, dir_fd=folder)
    except OSError as problem:
        raise OSError(problem.errno, problem.strerror, os.fspath(path)) from None
    if (what := not_a_file(os.fstat(descriptor).st_mode)) is not None:
        os.close(descriptor)
        raise OSError(errno.EINVAL, what, os.fspath(path))
    return descriptor


def _replace(folder: int, name: str, content: bytes) -> None:
    temporary = f".{name}.{os.urandom(6).hex()}"
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | PLAIN, 0o666, dir_fd=folder)
    try:
        with open(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, name, src_dir_fd=folder, dst_dir_fd=folder)
        os.fsync(folder)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary, dir_fd=folder)
        raise


def _remove_tree(folder: int, name: str) -> None:
    """Remove a folder of any depth, whatever the permissions in it: each folder below is moved up before it is emptied."""
    top = _made_writable(folder, name)
    try:
        waiting = os.listdir(top)
        while waiting:
            one = waiting.pop()
            if not _is_folder(top, one):
                os.unlink(one, dir_fd=top)
                continue
            below = _made_writable(top, one)
            try:
                for inner in os.listdir(below):
                    if not _is_folder(below, inner):
                        os.unlink(inner, dir_fd=below)
                        continue
                    os.close(_made_writable(below, inner))
                    waiting.append(f".{os.urandom(8).hex()}")
                    os.rename(inner, waiting[-1], src_dir_fd=below, dst_dir_fd=top)
            finally:
                os.close(below)
            os.rmdir(one, dir_fd=top)
    finally:
        os.close(top)
    os.rmdir(name, dir_fd=folder)


def _is_folder(folder: int, name: str) -> bool:
    return stat.S_ISDIR(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode)


def _made_writable(folder: int, name: str) -> int:
    """Return a descriptor of a folder that its owner may list and empty."""
    there = os.open(name, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=folder)
    try:
        if os.fstat(there).st_mode & stat.S_IRWXU != stat.S_IRWXU:
            os.chmod(f"/proc/self/fd/{there}", stat.S_IRWXU)
    finally:
        os.close(there)
    return os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=folder)
