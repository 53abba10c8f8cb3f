"""Paths of packages, as texts that Python can compute with: each package has one root, whether it is here or not.

`get_package_share_directory("P")` is below a root that is not here, laid out as colcon does it: a prefix for each package, or
one for all. Functions that look at files are led to where the package is here; `spelled` turns such paths into
`$(find-pkg-share P)`, and refuses what has lost its root. What depends on the root itself shows under another one.
"""

import builtins
import errno
import io
import os
import pathlib
import re
import stat
import sys
from collections.abc import Callable
from typing import Any

from fogspec.importers.launch.found import COMPUTED
from fogspec.importers.launch.sandboxed.values import (
    OWN,
    Place,
    Refused,
    Stop,
    Unknown,
    here,
    marked,
    note,
    plain,
    unmarked,
)

ROOT: list[str] = []
PATH: list[re.Pattern[str]] = []
LOST = re.compile(r"\.fogspec", re.IGNORECASE)
ASKED: set[str] = set()  # packages whose path the launch file has
FOLDERS: dict[str, str] = {}  # packages that are here
INSTALLED: list[str] = []  # where others may be
# Directories that no package owns and the launch file may look into: its own, and the scratch directory.
FREE: list[str] = []
NAMED: dict[str, Place] = {}  # names of temporary files, by where they are made
MOST_DATA = 1 << 20
LOOKS = ("genericpath.py", "posixpath.py", "pathlib.py", "_local.py", "glob.py")  # modules that look for their caller
_open, _os_open, _stat, _lstat = io.open, os.open, os.stat, os.lstat
_listdir, _scandir, _access = os.listdir, os.scandir, os.access


def lay_out(root: str) -> None:
    """Have packages below a root; a `*` in it is the name of each."""
    of_each = r"(?P<name>[\w.-]+)(?P<below>/share/(?P=name)(?![\w.-])|/share(?![\w.-]))?"
    of_all = r"(?![\w.-])(?P<below>/share(/(?P<name>[\w.-]+))?)?"
    ROOT[:], PATH[:] = [root], [re.compile(re.escape(root.rstrip("*")) + (of_each if root.endswith("*") else of_all))]


def prefix(name: str) -> str:
    """Return a package's prefix."""
    ASKED.add(name)
    return ROOT[0].replace("*", name)


def share(name: str) -> str:
    """Return a package's share directory."""
    return f"{prefix(name)}/share/{name}"


def spelled(text: str) -> str:
    """Return a text as a spec writes it; raise Refused if a path has lost its package, or a part is not known."""
    found = PATH[0].sub(_spelled, virtual(unmarked(text)))
    if LOST.search(found):
        raise Refused(COMPUTED)
    return _temporary(found) if FREE and FREE[-1] in found else found


def _temporary(text: str) -> str:
    """Return a text with the names of temporary files as the machine may have them; raise Refused if one is written here."""
    for name, place in NAMED.items():
        if name in text:
            if any(name in one for one in _listdir(FREE[-1])):
                raise Refused("it is a file that the launch file writes", place)
            note(place, "a temporary file is new at each launch; in the spec it has the same name each time")
    return text.replace(FREE[-1], "/tmp")  # noqa: S108  (a path of the machine that starts the node)


class Names:
    """The names of temporary files: the same each time that a launch file is read."""

    def __next__(self) -> str:
        """Return the next name, as long as one of Python's."""
        name = f"{len(NAMED) + 1:08d}"
        NAMED[name] = here()
        return name


def _spelled(match: re.Match[str]) -> str:
    name, below = match["name"], match["below"]
    if name is None:
        return f"$(find-pkg-prefix){below or ''}"
    if below is None:
        if name not in ASKED:  # such as the prefix of another package with more letters behind it
            raise Refused(COMPUTED)
        return f"$(find-pkg-prefix {name})"
    return f"$(find-pkg-share {name})" + ("" if below != "/share" else "/..")


def virtual(path: str) -> str:
    """Return a real path of a package as the launch file sees it."""
    for name, folder in FOLDERS.items():
        if path == folder or path.startswith(f"{folder}/"):
            return share(name) + path[len(folder) :]
    return path


def folder_of(name: str) -> str | None:
    """Return where a package's share directory is here."""
    if name not in FOLDERS:
        at = next((at for one in INSTALLED if _exists(at := f"{one}/share/{name}")), None)
        if at is None:
            return None
        FOLDERS[name] = at
    return FOLDERS[name]


def real(path: str) -> tuple[str | None, str | None]:
    """Return the file here that a path means and its package: no file if that is not here, no package if it is in none."""
    path = os.path.normpath(path)
    match = PATH[0].match(path)
    if match is None:
        return path, None
    name = match["name"] or ""
    folder = folder_of(name) if name else None
    if folder is None or not match["below"] or match["below"] == "/share":
        return None, name
    below = path[match.end() :].lstrip("/")
    at = os.path.join(folder, below) if below else folder
    if below and not _exists(at):
        # A build may install a file to another folder than where its source is.
        some = [one for deep in _below(folder) if _exists(one := f"{deep}/{os.path.basename(below)}")]
        at = some[0] if len(some) == 1 else at
    return at, name


def content(path: str) -> str:
    """Return a file's text; raise Refused if it is not here."""
    path = opened(path)
    at, name = real(path)
    if at is None:
        raise Refused(f"{_short(path)} is not here: the package {name} is not")
    try:
        with _open(at, "rb") as file:
            data: bytes = file.read(MOST_DATA + 1)
    except (OSError, ValueError):
        raise Refused(f"{_short(path)} is not here") from None
    if len(data) > MOST_DATA:
        raise Refused(f"{_short(path)} is larger than {MOST_DATA >> 20} MiB")
    return data.decode("utf-8", "replace")


def opened(path: Any) -> str:
    """Return a path that is known; raise Refused if it is not."""
    if isinstance(path, Unknown):
        raise Refused(path._why, path._place)
    path = os.fspath(path)
    if marked(path):
        raise Refused(f"only the machine has {unmarked(path)}")
    return plain(path)


def _short(path: str) -> str:
    return PATH[0].sub(_spelled, path)


def _below(folder: str) -> list[str]:
    found: list[str] = []
    for depth in (1, 2):
        above = [folder] if depth == 1 else list(found)
        for one in above:
            try:
                found += [
                    f"{one}/{name}"
                    for name in _listdir(one)
                    if not name.startswith(".") and os.path.isdir(f"{one}/{name}")
                ]
            except OSError:
                continue
    return found


def _exists(path: str) -> bool:
    try:
        return bool(_stat(path))
    except (OSError, ValueError):
        return False


def compared(kind: str, one: Any, other: Any) -> Any:
    """Return whether two are the same, or one is in the other; raise Stop if a package's path meets another whole path."""
    for each in other if isinstance(other, (list, tuple, set, dict)) and kind.endswith("in") else [other]:
        texts = [plain(text) for text in (one, each) if isinstance(text, str)]
        texts += [plain(os.fspath(path)) for path in (one, each) if isinstance(path, pathlib.PurePath)]
        of_packages = [PATH[0].match(text) is not None for text in texts if text[:1] == "/"]
        if sorted(of_packages) == [False, True]:
            raise Stop(COMPUTED)
    if kind.endswith("in"):
        return (one in other) is (kind == "in")
    return one == other if kind == "eq" else one != other


def _is_free(path: str) -> bool:
    return any(
        path == one or path.startswith(f"{one}/") for one in (*FREE, sys.prefix, sys.base_prefix, "/usr", "/lib")
    )


def is_asked() -> bool:
    """Return whether the launch file looks, and not a module of Python for itself."""
    frame: Any = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename not in OWN:
        name = os.path.basename(frame.f_code.co_filename)
        if frame.f_code.co_filename != __file__ and name not in LOOKS:
            return False
        frame = frame.f_back
    return frame is not None


def _led(function: Callable[..., Any], absent: Callable[[str, str], Any]) -> Callable[..., Any]:
    """Return a function of os that is led to where a package is here."""

    def do(path: Any = ".", *args: Any, **words: Any) -> Any:
        if isinstance(path, (int, bytes)):
            return function(path, *args, **words)
        try:
            name = opened(path)
        except Refused as refused:
            raise Stop(refused.why, refused.place) from None
        at, package = real(name) if PATH[0].match(name) else (name, "")
        if at is None:
            return absent(name, package or "")
        if package == "" and function is not _scandir and is_asked() and not _is_free(os.path.normpath(name)):
            note(here(), f"only the machine can tell whether {name[:80]} is there: it is taken as absent")
            raise FileNotFoundError(errno.ENOENT, "only the machine has it", name)
        return function(at, *args, **words)

    return do


def _present(path: str, package: str) -> os.stat_result:
    if package not in FOLDERS and not PATH[0].fullmatch(path):
        note(here(), f"{_short(path)} is taken as present: the package {package} is not here")
    kind = stat.S_IFREG if "." in os.path.basename(path) else stat.S_IFDIR
    return os.stat_result((kind | 0o755, 0, 0, 1, 0, 0, 0, 0, 0, 0))


def _not_listed(path: str, package: str) -> Any:
    raise Stop(f"the package {package} is not here, and a directory of it is listed")


def _guarded(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `open`, led to where a package is here, and stopped at what is not to be read or written."""

    def do(file: Any, mode: Any = "r", *args: Any, **words: Any) -> Any:
        if isinstance(file, (int, bytes)):
            return function(file, mode, *args, **words)
        try:
            path = opened(file)
        except Refused as refused:
            raise Stop(refused.why, refused.place) from None
        at, package = real(path) if PATH[0].match(path) else (path, None)
        if at is None:
            raise Stop(f"{_short(path)} is not here: the package {package} is not")
        writes = not set(mode) <= set("rbt") if isinstance(mode, str) else bool(mode & (os.O_WRONLY | os.O_RDWR))
        if package and writes:
            raise Stop(f"it writes {_short(path)}, and a launch file is only read")
        try:
            return function(at, mode, *args, **words)
        except PermissionError:
            raise Stop(
                f"it {'writes' if writes else 'reads'} {path[:80]}, which is in no package that is here"
            ) from None

    return do


def install() -> None:
    """Lead the functions that look at files to the packages that are here."""
    builtins.open = io.open = _guarded(_open)
    os.open = _guarded(_os_open)
    os.stat, os.lstat = _led(_stat, _present), _led(_lstat, _present)
    os.access = _led(_access, lambda path, package: True)
    os.listdir, os.scandir = _led(_listdir, _not_listed), _led(_scandir, _not_listed)
