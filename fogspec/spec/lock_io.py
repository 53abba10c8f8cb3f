"""The lock on disk, and the files that are sent to machines: every command takes their digests from here."""

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path

from fogspec.base.errors import InvalidInput, OutOfDate
from fogspec.base.layout import Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.yaml.writer import yaml_text
from fogspec.spec.loader import read_document
from fogspec.spec.lockfile import (
    Lock,
    Pins,
    differing,
    files_needed,
    ignored_patterns,
    sends_files,
    some,
    words_of_commands,
)
from fogspec.spec.schema import Application
from fogspec.spec.tree import Tree


def read_lock(path: Path) -> Lock | None:
    """Return the lock, None if there is none; raise DiagnosticError if it is damaged."""
    files = ProjectFiles(path.parent)
    return read_document(path, Lock, files) if files.exists(path) else None


def read_pins(layout: Layout) -> Pins | None:
    """Return the lock's pins for this application."""
    lock = read_lock(layout.lock)
    return None if lock is None else lock.spec.applications.get(layout.application)


def lock_text(lock: Lock) -> str:
    """Return the file's text, applications ordered by name."""
    data = lock.model_dump(mode="json")
    applications = data["spec"]["applications"]
    data["spec"]["applications"] = {name: applications[name] for name in sorted(applications)}
    return yaml_text(data, "fogspec lock")


def sent_tree(application: Application, layout: Layout) -> Tree | None:
    """Return the tree that is sent to each machine; None if the application needs no files there."""
    if not sends_files(application):
        return None
    folder = layout.spec.parent
    return Tree(folder, ignored_patterns(application, folder == layout.root), layout.spec.name)


def files_sent(application: Application, layout: Layout) -> dict[str, str]:
    """Return the digest of each file that is sent to a machine, by its path in the spec's directory.

    Raise InvalidInput for a tree that cannot be sent; see `Tree.digests`.
    """
    tree = sent_tree(application, layout)
    return {} if tree is None else tree.digests()


def snapshot(application: Application, layout: Layout, target: Path, expected: Mapping[str, str] | None) -> Path | None:
    """Copy the files that are sent to `target`, and return it; None if there are none to send.

    Raise OutOfDate, naming the files, if the copy is not what is `expected`, and then leave nothing; otherwise raise as
    `files_sent` does.
    """
    tree = sent_tree(application, layout)
    if tree is None:
        return None
    layout.files.make_folder(target)
    try:
        copied = tree.snapshot(target)
        if expected is not None and (changed := differing(expected, copied)):
            raise OutOfDate(f"{some(changed)}: changed since this command began: nothing was started", "run it again")
    except BaseException:
        with contextlib.suppress(OSError):
            layout.files.remove_tree(target)
        raise
    return target


def check_sent(application: Application, layout: Layout, measured: bool) -> None:
    """Raise InvalidInput if something that the spec names is there and not sent, before a machine is paid for."""
    folder, tree = layout.spec.parent, sent_tree(application, layout)
    named = [*files_needed(application, measured), *words_of_commands(application, measured)]
    for field, name in named:
        path = os.path.normpath(name)
        if tree is not None and tree.excludes(path) and (folder / path).exists():
            raise InvalidInput(
                f"{layout.spec}: {field} names {name}, which is not sent to machines",
                f"rename it: these patterns leave files out: {', '.join(tree.ignored)}",
            )


def lock_drift(pins: Pins | None, sent: Mapping[str, str]) -> list[str]:
    """Return the paths of files that are sent, or were when they were locked, and differ from the lock."""
    return [] if pins is None else differing(pins.files, sent)
