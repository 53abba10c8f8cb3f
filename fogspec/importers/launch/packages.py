"""Where the share folder of a ROS 2 package is on this machine, if it is here: its name is otherwise kept as it is."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

from fogspec.base.files import read_bounded
from fogspec.importers.launch.found import MOST_DATA_BYTES

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
