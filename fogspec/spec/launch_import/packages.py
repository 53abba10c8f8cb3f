"""Where the share folder of a ROS 2 package is on this machine, if it is here: its name is otherwise kept as it is."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

from fogspec.base.files import read_bounded
from fogspec.spec.launch_import.found import MOST_DATA_BYTES, SHARE

MOST_FOLDERS = 20_000
DEEPEST = 8
NAME = re.compile(r"<name>\s*([A-Za-z0-9_.-]+)\s*</name>")
LEFT_OUT = {"build", "log", "node_modules", "__pycache__", "doc", "docs", "test", "src_gen"}


class Packages:
    """Packages below the given folders, in the workspace of a launch file, and where ROS 2 is sourced."""

    def __init__(self, launch: Path, also: list[Path]) -> None:
        self.folders: dict[str, Path] = {}
        self.left = MOST_FOLDERS
        own = package_of(launch)
        self.own = own[0] if own else None
        if own:
            self.folders[own[0]] = own[1]
        for root in [*also, *([_root(own[1])] if own else [])]:
            for folder in self._below(root, 0):
                if name := _name(folder):
                    self.folders.setdefault(name, folder)
        self.installed = [Path(one) for one in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if one]

    def share(self, name: str) -> Path | None:
        """Return the package's folder that holds its launch files and configuration; None if it is not here."""
        if name in self.folders:
            return self.folders[name]
        if "/" in name or name.startswith("."):
            return None
        return next((at for one in self.installed if (at := one / "share" / name).is_dir()), None)

    def file(self, text: str) -> Path | None:
        """Return the file here that a text with `$(find-pkg-share P)` in front names; None if there is none."""
        match = SHARE.match(text)
        if match is None:
            path = Path(text)
            return path if text.startswith("/") and path.is_file() else None
        folder = self.share(match[1])
        if folder is None:
            return None
        path = folder / text[match.end() :].lstrip("/")
        try:
            if path.is_file():
                return path
            return _elsewhere(folder, Path(text[match.end() :]).name)
        except (OSError, ValueError):
            return None

    def shared(self, path: Path) -> str | None:
        """Return a file or folder of a package as `$(find-pkg-share P)/…`; None if it is in none."""
        for name, folder in self.folders.items():
            if path == folder or path.is_relative_to(folder):
                tail = path.relative_to(folder).as_posix()
                return f"$(find-pkg-share {name})" + ("" if tail == "." else f"/{tail}")
        found = package_of(path)
        if found is None:
            return None
        self.folders.setdefault(*found)
        return self.shared(path) if self.folders[found[0]] == found[1] else None

    def _below(self, folder: Path, depth: int) -> Iterator[Path]:
        self.left -= 1
        if self.left < 0 or depth > DEEPEST:
            return
        try:
            with os.scandir(folder) as entries:
                below = sorted(entries, key=lambda one: one.name)
        except OSError:
            return
        if any(one.name == "package.xml" for one in below):
            yield folder
            return
        for one in below:
            if not one.name.startswith(".") and one.name not in LEFT_OUT and one.is_dir(follow_symlinks=False):
                yield from self._below(folder / one.name, depth + 1)


def package_of(path: Path) -> tuple[str, Path] | None:
    """Return name and folder of the package that a file belongs to."""
    for folder in list(path.absolute().parents)[:8]:
        if name := _name(folder):
            return name, folder
    return None


def _elsewhere(folder: Path, name: str) -> Path | None:
    """Return the only file of this name in a package, whose build may install it to another folder."""
    found = [one for one in (*folder.glob(f"*/{name}"), *folder.glob(f"*/*/{name}")) if one.is_file()]
    return found[0] if len(found) == 1 and "*" not in name else None


def _name(folder: Path) -> str | None:
    try:
        content = read_bounded(folder / "package.xml", MOST_DATA_BYTES)
    except OSError:
        return None
    match = NAME.search(content.decode("utf-8", "replace"))
    return match[1] if match else None


def _root(package: Path) -> Path:
    """Return the folder whose packages belong together: the nearest that is a repository or called src."""
    for folder in (package, *list(package.parents)[:4]):
        if folder.name == "src" or (folder / ".git").exists():
            return folder
    return package.parent if package.parent != Path(package.anchor) else package
