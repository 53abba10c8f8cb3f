"""Secrets stay where they are: their values are taken out of everything that a campaign keeps or shows."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogspec.effects.benchmark.collecting import opened
from fogspec.effects.benchmark.orders import Event
from fogspec.effects.benchmark.watching import Watcher
from fogspec.effects.disk.files import write_bytes

SHORTEST = 4
ENDS = ("is done", "is tried again", "is no longer wanted")
FILE_LIMIT = 256 * 2**20


@dataclass(frozen=True, slots=True)
class Secrets:
    """Values of environment variables, and what is written in their place; what is shorter than `SHORTEST` is no secret."""

    values: Mapping[str, str]

    @classmethod
    def of(cls, names: Iterable[str]) -> "Secrets":
        """Those of these variables that are set."""
        return cls({os.environ[name]: f"${name}" for name in names if len(os.environ.get(name, "")) >= SHORTEST})

    def out_of(self, text: str) -> str:
        """The text without them; the longest first, for one may be part of another."""
        for value in sorted(self.values, key=len, reverse=True):
            text = text.replace(value, self.values[value])
        return text

    def out_of_files(self, folder: Path) -> None:
        """Write what an attempt left anew where it has one: a workload prints what it likes."""
        if not self.values:
            return
        for path in (Path(at, name) for at, _, names in os.walk(folder) for name in names):
            try:
                with opened(path) as file:
                    before = file.read(FILE_LIMIT)
            except OSError:
                continue
            after = self.out_of(before.decode("utf-8", "surrogateescape")).encode("utf-8", "surrogateescape")
            if after != before:
                write_bytes(path, after)


@dataclass(slots=True)
class Teller:
    """Tells a watcher what happens, without secrets; remembers where the logs of each sample are."""

    watcher: Watcher
    secrets: Secrets
    folders: dict[str, Path] = field(default_factory=dict)

    def __call__(self, event: Event) -> None:
        """Pass it on."""
        if event.folder is not None:
            self.folders[event.sample.id] = event.folder
            if event.what in ENDS:
                self.secrets.out_of_files(event.folder)
        detail = None if event.detail is None else self.secrets.out_of(event.detail)
        self.watcher(replace(event, detail=detail))
