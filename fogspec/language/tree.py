"""The tree that is sent to machines: the files of the spec's directory, digested and copied by one walk.

What is digested is what is sent: `digests` and `snapshot` list the same files, and a snapshot's digests are of the bytes that
it holds. A file that is not listed reaches no machine.
"""

import contextlib
import fnmatch
import hashlib
import itertools
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.errors import InvalidInput
from fogspec.base.files import POINTER, POINTER_BYTES, PULL
from fogspec.base.layout import LOCK, Layout
from fogspec.language.lockfile import ignored_patterns
from fogspec.language.named_files import sends_files
from fogspec.language.schema import Application

MOST_FILES = 10_000
MOST_BYTES = 8 << 30
MOST_DEEP = 64
BLOCK = 1 << 20
DOCUMENT = re.compile(rb"^apiVersion:\s*[\"']?fogspec\.dev/", re.MULTILINE)
APPLICATION = re.compile(rb"^kind:\s*[\"']?Application\b", re.MULTILINE)
FIX = "remove it, or name the files that machines need in spec.files"


@dataclass(frozen=True)
class Tree:
    """The files of a directory, except those that match a pattern of `ignored`, and directories with a spec of their own.

    `spec` is the name of the spec in it. A pattern with a slash is compared with the path below the directory, another one
    with every name on that path. With `only`, just these files and directories are in the tree. fogspec's own documents at
    the top of the directory do not belong to the tree: what a measurement reads of them has digests of its own.
    """

    folder: Path
    ignored: tuple[str, ...]
    spec: str = ""
    only: tuple[str, ...] | None = None
    names: re.Pattern[str] = field(init=False)
    paths: re.Pattern[str] = field(init=False)

    def __post_init__(self) -> None:
        """Compile the patterns, and bring the listed paths into one form."""
        if self.only is not None:
            object.__setattr__(self, "only", tuple(os.path.normpath(one) for one in self.only))
        patterns = [one.rstrip("/") for one in self.ignored]
        object.__setattr__(self, "names", _any(one for one in patterns if "/" not in one))
        object.__setattr__(self, "paths", _any(one.lstrip("/") for one in patterns if "/" in one))

    def digests(self) -> dict[str, str]:
        """Return the digest of each file by its path: `sha256:…`, `executable sha256:…`, or `link to …`.

        Times, owners, empty directories and the order of the file system do not count. Raise InvalidInput for a link that
        leads outside, a device or pipe, an unreadable file, a name that is not printable text, and for too much.
        """
        return self._each(None)

    def snapshot(self, target: Path) -> dict[str, str]:
        """Copy the files to an empty directory `target` and return the digests of the copies; raise as `digests` does.

        Copies have the modes 0644 and 0755. `.skyignore` has no pattern: SkyPilot then sends all of `target`, and reads
        no `.gitignore`.
        """
        (target / ".skyignore").write_text("# everything here is sent\n", encoding="utf-8")
        return self._each(target)

    def pointers(self) -> Iterator[str]:
        """Yield the paths of the files that are pointers of Git LFS, of as many as may be sent; raise as `digests` does."""
        for path, entry in itertools.islice(self._walk(self.folder, ""), MOST_FILES):
            with contextlib.suppress(OSError):
                if entry.is_file(follow_symlinks=False) and entry.stat().st_size < POINTER_BYTES:
                    with open(entry.path, "rb") as file:
                        if file.read(len(POINTER)) == POINTER:
                            yield path

    def excludes(self, path: str) -> bool:
        """Return whether this path below the directory is left out, by a pattern or because it is not listed."""
        steps = path.split("/")
        above = ["/".join(steps[: end + 1]) for end in range(len(steps))]
        if any(self._ignores(one, step) for one, step in zip(above, steps, strict=True)):
            return True
        folders = [self.folder / one for one in above if (self.folder / one).is_dir()]
        return not (self.holds(path) or self._leads(path)) or any(map(has_spec, folders))

    def _each(self, target: Path | None) -> dict[str, str]:
        found: dict[str, str] = {}
        left = MOST_BYTES
        for path, entry in self._walk(self.folder, ""):
            if len(found) == MOST_FILES:
                raise InvalidInput(
                    f"{self.folder}: more than {MOST_FILES:,} files would be sent to each machine",
                    "name the files that machines need in spec.files",
                )
            if not path.isprintable():
                raise InvalidInput(f"{self.folder}: the name {path!r} is not printable text: it is not sent", FIX)
            to = None if target is None else target / path
            if to is not None:
                to.parent.mkdir(parents=True, exist_ok=True)
            try:
                if entry.is_symlink():
                    found[path] = self._link(path, to)
                else:
                    found[path], size = _file(Path(entry.path), to, left)
                    left -= size
            except OSError as problem:
                raise InvalidInput(f"{entry.path}: cannot be sent: {problem.strerror or problem}", FIX) from None
            except OverflowError:
                raise InvalidInput(
                    f"{self.folder}: more than {MOST_BYTES >> 30} GiB would be sent to each machine",
                    f"{path} passes the limit; name the files that machines need in spec.files",
                ) from None
        return dict(sorted(found.items()))

    def _walk(self, folder: Path, below: str) -> Iterator[tuple[str, os.DirEntry[str]]]:
        try:
            with os.scandir(folder) as entries:
                here = sorted(entries, key=lambda one: one.name)
        except OSError as problem:
            raise InvalidInput(f"{folder}: cannot be sent: {problem.strerror}", FIX) from None
        for entry in here:
            path = f"{below}{entry.name}"
            if self._ignores(path, entry.name) or not (self.holds(path) or self._leads(path)):
                continue
            if entry.is_dir(follow_symlinks=False):
                if has_spec(Path(entry.path)):
                    continue
                if path.count("/") == MOST_DEEP:
                    raise InvalidInput(f"{entry.path}: more than {MOST_DEEP} directories deep: it is not sent", FIX)
                yield from self._walk(Path(entry.path), f"{path}/")
            elif self.holds(path) and (below or (entry.name != self.spec and not is_document(Path(entry.path)))):
                yield path, entry

    def _ignores(self, path: str, name: str) -> bool:
        return bool(self.names.fullmatch(name) or self.paths.fullmatch(path))

    def holds(self, path: str) -> bool:
        """Return whether a path is one that is listed, or below a directory that is."""
        return self.only is None or any(one in (path, ".") or path.startswith(f"{one}/") for one in self.only)

    def _leads(self, path: str) -> bool:
        """Return whether something that is listed is below a path."""
        return self.only is not None and any(one.startswith(f"{path}/") for one in self.only)

    def _link(self, path: str, to: Path | None) -> str:
        """Return the entry of a link, and copy it; raise InvalidInput for one that leads out of the directory."""
        whole = self.folder / path
        goal = os.readlink(whole)
        # Both as it is written and as it is followed: a link on the way may lead elsewhere.
        written = os.path.normpath(os.path.join(os.path.dirname(path), goal))
        root = os.path.realpath(self.folder)
        outside = os.path.isabs(goal) or written.split("/")[0] == ".."
        if outside or not f"{os.path.realpath(whole)}/".startswith(f"{root}/"):
            raise InvalidInput(f"{whole}: leads outside {self.folder}, to {goal!r}: it is not sent", FIX)
        if not goal.isprintable():
            raise InvalidInput(f"{whole}: leads to a name that is not printable text: it is not sent", FIX)
        if to is not None:
            os.symlink(goal, to)
        return f"link to {goal}"


def _any(patterns: Iterator[str]) -> re.Pattern[str]:
    """Return a pattern that matches what one of these matches; none of them match nothing."""
    return re.compile("|".join(fnmatch.translate(one) for one in patterns) or r"(?!)")


def _file(path: Path, to: Path | None, most_bytes: int) -> tuple[str, int]:
    """Return a file's entry and size, and copy it; raise OverflowError if it has more bytes."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as source, contextlib.ExitStack() as files:
        about = os.fstat(descriptor)
        mode = about.st_mode
        if not stat.S_ISREG(mode):
            raise OSError(0, "it is neither a file, a directory nor a link", str(path))
        if about.st_size > most_bytes:
            raise OverflowError
        executable = bool(mode & stat.S_IXUSR)
        copy = None if to is None else files.enter_context(_created(to, 0o755 if executable else 0o644))
        content, size = hashlib.sha256(), 0
        while block := source.read(BLOCK):
            size += len(block)
            if block.startswith(POINTER) and about.st_size < POINTER_BYTES:
                said = Diagnostic(
                    "FS545", "it is a pointer of Git LFS, not the file", Span(os.fspath(path), 1, 1), PULL
                )
                raise DiagnosticError([said])
            if size > most_bytes:
                raise OverflowError
            content.update(block)
            if copy is not None:
                copy.write(block)
    return f"{'executable ' if executable else ''}sha256:{content.hexdigest()}", size


def _created(path: Path, mode: int) -> BinaryIO:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
    os.fchmod(descriptor, mode)
    return os.fdopen(descriptor, "wb")


def sent_tree(application: Application, layout: Layout) -> Tree | None:
    """Return the tree that is sent to each machine; None if the application needs no files there."""
    if not sends_files(application.spec):
        return None
    folder, files = layout.spec.parent, application.spec.files
    ignored = ignored_patterns(application, folder == layout.root)
    return Tree(folder, ignored, layout.spec.name, None if files is None else tuple(files))


def specs_in(folder: Path, but: str = "") -> list[str]:
    """Return the names of the files in a directory that are specs, `but` one, sorted; none if it cannot be read."""
    try:
        names = sorted(os.listdir(folder))
    except OSError:
        return []
    return [name for name in names if name != but and is_document(folder / name, APPLICATION)]


def has_spec(folder: Path) -> bool:
    """Return whether a directory belongs to another application: a spec stands in it."""
    return bool(specs_in(folder))


def is_document(path: Path, kind: re.Pattern[bytes] = DOCUMENT) -> bool:
    """Return whether a file is one of fogspec's own documents, such as a spec, and of a `kind`."""
    if not path.name.endswith((".yaml", ".yml", LOCK)) or path.is_symlink() or not path.is_file():
        return False
    with contextlib.suppress(OSError), open(path, "rb") as file:
        head = file.read(BLOCK)
        return bool(DOCUMENT.search(head) and kind.search(head))
    return False
