"""Secrets stay where they are: their values are taken out of everything that a campaign keeps or shows."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogspec.agent.secrecy import Secrets
from fogspec.base.files import write_bytes
from fogspec.bench.progress import ProgressReporter
from fogspec.bench.record import opened
from fogspec.bench.types import Event

ENDS = ("is done", "is tried again", "is no longer wanted")
FILE_LIMIT = 256 * 2**20


def redact_files(secrets: Secrets, folder: Path) -> None:
    """Write what an attempt left anew where it has a secret: a workload writes what it likes."""
    if not secrets:
        return
    for path in (Path(at, name) for at, _, names in os.walk(folder) for name in names):
        try:
            with opened(path) as file:
                before = file.read(FILE_LIMIT)
        except OSError:
            continue
        after = secrets.out_of_bytes(before)
        if after != before:
            write_bytes(path, after)


@dataclass(slots=True)
class RedactingProgress:
    """Tells a watcher what happens, without secrets; remembers where the logs of each sample are."""

    watcher: ProgressReporter
    secrets: Secrets
    folders: dict[str, Path] = field(default_factory=dict)

    def __call__(self, event: Event) -> None:
        """Pass it on."""
        if event.folder is not None:
            self.folders[event.sample.id] = event.folder
            if event.what in ENDS:
                redact_files(self.secrets, event.folder)
        detail = None if event.detail is None else self.secrets.out_of(event.detail)
        self.watcher(replace(event, detail=detail))
