"""Redaction of the values of secrets in everything that a campaign keeps or shows."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogspec.agent.secrecy import Secrets
from fogspec.base.files import open_untrusted, write_bytes
from fogspec.bench.progress import ProgressReporter
from fogspec.bench.types import Event, EventKind

FINAL = (EventKind.DONE, EventKind.RETRIED, EventKind.UNWANTED)
FILE_LIMIT = 256 * 2**20


def redact_files(secrets: Secrets, folder: Path) -> None:
    """Rewrite the files of an attempt that contain secrets: a workload can write anything."""
    if not secrets:
        return
    for path in (Path(at, name) for at, _, names in os.walk(folder) for name in names):
        try:
            with open_untrusted(path) as file:
                before = file.read(FILE_LIMIT)
        except OSError:
            continue
        after = secrets.out_of_bytes(before)
        if after != before:
            write_bytes(path, after)


@dataclass(slots=True)
class RedactingProgress:
    """Reports events without secrets; `folders` has the logs of each sample."""

    reporter: ProgressReporter
    secrets: Secrets
    folders: dict[str, Path] = field(default_factory=dict)

    def __call__(self, event: Event) -> None:
        """Redact the event and report it."""
        if event.folder is not None:
            self.folders[event.sample.id] = event.folder
            if event.kind in FINAL:
                redact_files(self.secrets, event.folder)
        detail = None if event.detail is None else self.secrets.out_of(event.detail)
        self.reporter(replace(event, detail=detail))
