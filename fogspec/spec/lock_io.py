"""The lock on disk, and the digests of files and folders beside a spec."""

import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from fogspec.base import digest
from fogspec.base.errors import InvalidInput
from fogspec.base.layout import Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.yaml.writer import yaml_text
from fogspec.spec.loader import read_document
from fogspec.spec.lockfile import Lock, Pins, files_needed, paths_deployed, paths_named
from fogspec.spec.schema import Application

# What building and running leave behind in a workspace: it is made again on the machine.
DERIVED = {"build", "install", "log"}
ANYWHERE = {"__pycache__", ".git", ".pytest_cache"}


def read_lock(path: Path) -> Lock | None:
    """Return the lock, None if there is none; raise DiagnosticError if it is damaged."""
    files = ProjectFiles(path.parent)
    return read_document(path, Lock, files) if files.exists(path) else None


def read_pins(layout: Layout) -> Pins | None:
    """Return the lock's pins for this application."""
    lock = read_lock(layout.lock)
    return None if lock is None else lock.spec.applications.get(layout.name)


def lock_text(lock: Lock) -> str:
    """Return the file's text, applications ordered by name."""
    data = lock.model_dump(mode="json")
    applications = data["spec"]["applications"]
    data["spec"]["applications"] = {name: applications[name] for name in sorted(applications)}
    return yaml_text(data, "fogspec lock")


def files_beside(application: Application, layout: Layout) -> dict[str, str]:
    """Return the digest of each existing file and directory that the spec names, by name."""
    return _digests(paths_named(application), layout)


def files_deployed(application: Application, layout: Layout) -> dict[str, str]:
    """Return the same for those that a deployment needs."""
    return _digests(paths_deployed(application), layout)


def _digests(words: Iterable[str], layout: Layout) -> dict[str, str]:
    folder = layout.spec.parent
    named = sorted({os.path.normpath(word) for word in words})
    return {name: tree_digest(folder / name) for name in named if name != "." and (folder / name).exists()}


def check_files(application: Application, layout: Layout, measured: bool) -> None:
    """Raise InvalidInput if something that the spec names is missing, before a machine is paid for."""
    folder = layout.spec.parent
    absent = [(field, name) for field, name in files_needed(application, measured) if not (folder / name).exists()]
    if absent:
        raise InvalidInput(
            f"{layout.spec}: {absent[0][0]} names {absent[0][1]}, which is not there",
            *(f"{field} names {name}, which is not there either" for field, name in absent[1:]),
            f"paths are relative to the spec's folder: {folder}",
        )


def tree_digest(path: Path) -> str:
    """Return the sha256 of a file's bytes, or of a directory's files: their names, executable bits and bytes.

    Times, owners, the order of the file system and build outputs do not count.
    """
    if not path.is_dir():
        return digest.of_value(_entry(path))
    return digest.of_value({found.relative_to(path).as_posix(): _entry(found) for found in _files(path)})


def _files(root: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(root):
        here = Path(parent)
        skipped = ANYWHERE | (DERIVED if here == root else set())
        yield from (here / name for name in folders if (here / name).is_symlink())
        folders[:] = [name for name in folders if name not in skipped]
        yield from (here / name for name in names if not name.endswith(".pyc"))


def _entry(path: Path) -> list[str]:
    if path.is_symlink():
        return ["link", os.readlink(path)]
    if not path.is_file():
        return ["other"]
    content = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            content.update(block)
    return ["executable" if os.access(path, os.X_OK) else "file", content.hexdigest()]


def lock_drift(application: Application, layout: Layout, pins: Pins | None) -> list[str]:
    """Return the names of files and directories next to the spec that differ from the lock."""
    if pins is None:
        return []
    now = files_beside(application, layout)
    return sorted(name for name in now.keys() | pins.files.keys() if now.get(name) != pins.files.get(name))
