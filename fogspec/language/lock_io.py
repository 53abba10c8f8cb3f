"""The lock on disk, and the files that are sent to machines: every command takes their digests from here."""

import contextlib
import os
import re
from collections.abc import Mapping
from pathlib import Path

from fogspec.base.errors import OutOfDate
from fogspec.base.layout import LOCK, Layout
from fogspec.base.yaml.writer import yaml_text
from fogspec.language.loader import read_document
from fogspec.language.lockfile import Lock, Pins, differing, some
from fogspec.language.schema import Application
from fogspec.language.tree import is_document, sent_tree

KIND = re.compile(rb"^kind:\s*[\"']?Lock\b", re.MULTILINE)


def read_pins(layout: Layout) -> Pins | None:
    """Return what the application's lock pins, None without a lock; raise DiagnosticError if it is damaged."""
    files = layout.beside_spec
    return read_document(layout.lock, Lock, files).spec if files.exists(layout.lock) else None


def lock_files(root: Path) -> list[Path]:
    """Return the locks of a project, sorted: in its folder of specs, else in its own; hidden folders are left out."""
    found = []
    top = root / "specs"
    for parent, folders, names in os.walk(top if top.is_dir() else root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        paths = (Path(parent, name) for name in names if name.endswith(LOCK))
        found += [path for path in paths if is_document(path, KIND)]
    return sorted(found)


def lock_text(pins: Pins) -> str:
    """Return the text of a lock."""
    return yaml_text(Lock(spec=pins).model_dump(mode="json", exclude_none=True), "fogspec lock")


def files_sent(application: Application, layout: Layout) -> dict[str, str]:
    """Return the digest of each file that is sent to a machine, by its path in the spec's directory.

    Raise InvalidInput for a tree that cannot be sent; see `Tree.digests`.
    """
    tree = sent_tree(application, layout)
    return {} if tree is None else tree.digests()


def snapshot(application: Application, layout: Layout, target: Path, expected: Mapping[str, str]) -> Path | None:
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
        if changed := differing(expected, copied):
            raise OutOfDate(f"{some(changed)}: changed since this command began: nothing was started", "run it again")
    except BaseException:
        with contextlib.suppress(OSError):
            layout.files.remove_tree(target)
        raise
    return target
