"""Records in an object store that a team shares, by exclusive creation alone: no object is ever overwritten.

A record is the object with the highest number in `KEY/`. Who read number 7 creates number 8, which the store does for one
writer only, and then looks whether a higher number is there: the numbers that it did not see may have been removed since.
The highest number is never removed, so a writer that was cut off for long always finds one above its own.
"""

import contextlib
import re
from collections.abc import Callable, Collection, Coroutine, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from fogspec.base.errors import NotInstalled, Refused
from fogspec.base.project_files import ProjectFiles
from fogspec.deploy.stores import Overtaken, Stored, StoreUnavailable

T = TypeVar("T")

# The package that fsspec takes for a scheme; the extra of that name installs it.
PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "az": "adlfs"}
BUCKET = r"[a-z0-9][a-z0-9._-]{1,220}[a-z0-9]"
PREFIX = r"[A-Za-z0-9_-][A-Za-z0-9._-]*(/[A-Za-z0-9_-][A-Za-z0-9._-]*)*"
URL = rf"({'|'.join(PACKAGES)})://{BUCKET}(/{PREFIX})?"
OBJECT = re.compile(r"([^/]+)/([0-9]{12})\.yaml")
MARK = "README.txt"
MARKED = (
    b"Live state of deployments, written by fogspec. The highest number in a folder counts. Do not edit it by hand.\n"
)
REMOVED = b"# nothing runs\n"
MOST_BYTES = 16 << 20
CONNECT_S, ANSWER_S = 10.0, 60.0
AT_ONCE = 16
LOOKS = 5


class Objects(Protocol):
    """Objects below a prefix, by their names there; every method raises some exception if there is no contact."""

    def sizes(self, folder: str) -> Mapping[str, int]:
        """Return the sizes in bytes of the objects in a folder, or of all for ""; empty for none."""
        ...

    def read(self, names: Collection[str]) -> Mapping[str, bytes]:
        """Return the contents of those of the objects that are there."""
        ...

    def create(self, name: str, content: bytes) -> None:
        """Create an object; raise FileExistsError, and change nothing, if there is one."""
        ...

    def remove(self, name: str) -> None:
        """Remove an object."""
        ...


class ObjectStore:
    """Records as numbered objects; `url` is their place, for people."""

    def __init__(self, url: str, objects: Objects) -> None:
        self.url = url
        self._objects = objects
        self._is_exclusive = False

    def read(self, key: str) -> Stored:
        """Return the record with this key; raise StoreUnavailable."""
        return self._read(key).get(key, Stored())

    def read_all(self) -> dict[str, Stored]:
        """Return all records by their keys; raise StoreUnavailable."""
        return self._read("")

    def write(self, key: str, content: bytes | None, replaced: str | None, why: str) -> str | None:
        """Replace the version `replaced` of a record, or remove it; return the new version.

        Raise Overtaken if the record is another version, Refused if the store overwrites objects, StoreUnavailable if
        it refuses or what became of the record is unknown.
        """
        self._check_exclusive()
        number = self._after(key, replaced)
        name, whole = _name(key, number), REMOVED if content is None else content
        try:
            self._objects.create(name, whole)
        except FileExistsError:
            if self._content(name) != whole:  # else it is this write, whose answer was lost, so that it was sent again
                raise Overtaken from None
        except Exception as failed:
            if self._content(name) != whole:
                if self._newest(key) != number - 1:
                    raise Overtaken from None
                raise StoreUnavailable(self.url, _reason(failed)) from None
        numbers = self._numbers(key).get(key, [])
        if numbers and numbers[-1] > number:
            self._try_to_remove(name)
            raise Overtaken
        # The one before stays for who has just seen it in a list and is about to read it.
        for old in (one for one in numbers if one < number - 1):
            self._try_to_remove(_name(key, old))
        return None if content is None else str(number)

    def path(self, key: str) -> str:
        """Return where a record is, for people."""
        return f"{self.url}/{key}"

    def _read(self, folder: str) -> dict[str, Stored]:
        for _ in range(LOOKS):
            names = {_name(key, numbers[-1]): (key, numbers[-1]) for key, numbers in self._numbers(folder).items()}
            found = self._reached(partial(self._objects.read, names))
            if len(found) == len(names):  # else one was replaced and removed since it was listed
                held = [(*names[name], content) for name, content in found.items() if content != REMOVED]
                return {key: Stored(str(number), content) for key, number, content in held}
        raise StoreUnavailable(self.url, "its records are replaced faster than they can be read")

    def _numbers(self, folder: str) -> dict[str, list[int]]:
        """Return the numbers of each record in a folder, in order."""
        found: dict[str, list[int]] = {}
        for name, size in self._reached(lambda: self._objects.sizes(folder)).items():
            if (one := OBJECT.fullmatch(name)) is not None and (not folder or one[1] == folder):
                if size > MOST_BYTES:
                    raise StoreUnavailable(self.url, f"{name} has {size} bytes, which no record has")
                found.setdefault(one[1], []).append(int(one[2]))
        return {key: sorted(found[key]) for key in sorted(found)}

    def _newest(self, key: str) -> int:
        """Return the highest number of a record, 0 if there is none."""
        return max(self._numbers(key).get(key, []), default=0)

    def _after(self, key: str, replaced: str | None) -> int:
        """Return the number that comes after a version; raise Overtaken if there is to be no record, and there is one."""
        if replaced is not None:
            return int(replaced) + 1
        newest = self._newest(key)
        if newest and self._content(_name(key, newest)) != REMOVED:
            raise Overtaken
        return newest + 1

    def _content(self, name: str) -> bytes | None:
        return self._reached(lambda: self._objects.read([name])).get(name)

    def _check_exclusive(self) -> None:
        """Raise Refused unless the store was seen to create an object only where there is none."""
        for _ in range(0 if self._is_exclusive else 2):
            try:
                self._reached(lambda: self._objects.create(MARK, MARKED))
            except FileExistsError:
                self._is_exclusive = True
                return
        if not self._is_exclusive:
            raise Refused(
                f"{self.url}: the store overwrites an object that was to be created only if there is none: "
                "two commands could deploy at once",
                "use a store that supports conditional writes (S3: If-None-Match), or write state: git",
            )

    def _reached(self, step: Callable[[], T]) -> T:
        """Return what a step returns; raise StoreUnavailable if it fails otherwise than by FileExistsError."""
        try:
            return step()
        except (FileExistsError, NotInstalled):
            raise
        except Exception as failed:
            raise StoreUnavailable(self.url, _reason(failed)) from None

    def _try_to_remove(self, name: str) -> None:
        with contextlib.suppress(Exception):
            self._objects.remove(name)


class FsspecObjects:
    """Objects below `SCHEME://BUCKET/PREFIX`, by the package that fsspec takes for the scheme and the user's own log-in."""

    def __init__(self, url: str) -> None:
        self._scheme, _, self._root = url.partition("://")
        self._opened: Any = None

    def sizes(self, folder: str) -> Mapping[str, int]:
        """Return the sizes of the objects in a folder, or of all for ""."""
        system = self._system()
        system.invalidate_cache()
        found = self._call(system._find, f"{self._root}/{folder}".rstrip("/"), detail=True)
        below = f"{self._root}/"
        return {path.removeprefix(below): int(one["size"]) for path, one in found.items() if path.startswith(below)}

    def read(self, names: Collection[str]) -> Mapping[str, bytes]:
        """Return the contents of those of the objects that are there."""
        import asyncio  # slow to import, and most projects have their state elsewhere

        system = self._system()

        async def one(name: str, limit: asyncio.Semaphore) -> bytes | None:
            async with limit:
                try:
                    return bytes(await system._cat_file(f"{self._root}/{name}"))
                except FileNotFoundError:
                    return None

        async def all_of_them() -> list[bytes | None]:
            limit = asyncio.Semaphore(AT_ONCE)
            return await asyncio.gather(*(one(name, limit) for name in names))

        found = zip(names, self._call(all_of_them) if names else [], strict=True)
        return {name: content for name, content in found if content is not None}

    def create(self, name: str, content: bytes) -> None:
        """Create an object; raise FileExistsError if there is one."""
        self._call(self._system()._pipe_file, f"{self._root}/{name}", content, mode="create")

    def remove(self, name: str) -> None:
        """Remove an object."""
        self._call(self._system()._rm_file, f"{self._root}/{name}")

    def _call(self, step: Callable[..., Coroutine[Any, Any, Any]], *words: Any, **named: Any) -> Any:
        from fsspec.asyn import sync

        return sync(self._system().loop, step, *words, timeout=ANSWER_S, **named)

    def _system(self) -> Any:
        """Return fsspec's file system; raise NotInstalled without the package."""
        if self._opened is None:
            package = PACKAGES[self._scheme]
            try:
                import fsspec  # only a project that has this state needs it

                kind = fsspec.get_filesystem_class(self._scheme)
            except ImportError as missing:
                raise NotInstalled(
                    f"{self._scheme}://{self._root}: the package {package} is not installed: {_reason(missing)}",
                    f"pip install 'fogspec[{self._scheme}]'",
                ) from None
            options: dict[str, Any] = {"use_listings_cache": False, "skip_instance_cache": True}
            if self._scheme == "s3":
                again = {"max_attempts": 2, "mode": "standard"}
                options["config_kwargs"] = {
                    "connect_timeout": CONNECT_S,
                    "read_timeout": ANSWER_S / 3,
                    "retries": again,
                }
            self._opened = kind(**options)
            if hasattr(self._opened, "retries"):
                self._opened.retries = 2
        return self._opened


class FolderObjects:
    """Objects as files of a folder on this computer."""

    def __init__(self, root: str) -> None:
        self._root, self._files = Path(root), ProjectFiles(Path(root))

    def sizes(self, folder: str) -> Mapping[str, int]:
        """Return the sizes of the files in a folder, or of all for ""; raise OSError if the root is missing."""
        self._root.stat()
        names = [folder] if folder else self._files.names(self._root)
        found = {f"{one}/{name}" for one in names for name in self._files.names(self._root / one)}
        sizes = {name: self._files.stat(self._root / name) for name in found}
        return {name: status.st_size for name, status in sizes.items() if status is not None}

    def read(self, names: Collection[str]) -> Mapping[str, bytes]:
        """Return the contents of those of the files that are there."""
        found = {}
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                found[name] = self._files.read(self._root / name, MOST_BYTES)
        return found

    def create(self, name: str, content: bytes) -> None:
        """Create a file; raise FileExistsError if there is one."""
        self._root.stat()
        self._files.create_whole(self._root / name, content)

    def remove(self, name: str) -> None:
        """Remove a file."""
        self._files.remove(self._root / name)


def _name(key: str, number: int) -> str:
    return f"{key}/{number:012}.yaml"


def _reason(failed: Exception) -> str:
    """Return an error in one line."""
    return next((line for line in str(failed).splitlines() if line.strip()), type(failed).__name__)
