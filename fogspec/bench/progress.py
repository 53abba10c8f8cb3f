"""Showing a benchmark while it runs: a live table on a terminal, one line a change elsewhere, or JSON events."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

from fogspec.backends.protocol import Progress
from fogspec.base import units
from fogspec.base.units import rounded
from fogspec.bench.record import opened
from fogspec.bench.types import Event
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured


class ProgressReporter(AbstractContextManager["ProgressReporter"], Protocol):
    """Told of everything that happens to a sample."""

    def __call__(self, event: Event) -> None:
        """Show it."""
        ...


@dataclass(slots=True)
class Tail:
    """How far a growing timings file has come: requests so far and the sum of the successful ones' latency."""

    offset: int = 0
    requests: int = 0
    ok: int = 0
    total_s: float = 0.0

    def take(self, progress: Progress) -> None:
        """Go by the file where it is here, else by what its machine says."""
        if progress.timings is not None:
            if self.offset == 0:
                self.requests, self.ok, self.total_s = 0, 0, 0.0
            self.read(progress.timings)
        elif (said := progress.so_far) is not None:
            self.requests, self.ok = said.requests, 0 if said.mean_s is None else said.requests
            self.total_s = (said.mean_s or 0.0) * self.ok

    def read(self, path: Path) -> None:
        """Take in what is new, whole lines only."""
        try:
            with opened(path) as file:
                file.seek(self.offset)
                new = file.read(2**20)
        except OSError:
            return
        whole = new.rfind(b"\n") + 1
        self.offset += whole
        for line in new[:whole].splitlines():
            try:
                record = json.loads(line)
                good = record["ok"] is True
                self.requests += 1
                if good:
                    self.total_s += float(record["latency_s"])
                    self.ok += 1
            except (ArithmeticError, ValueError, TypeError, KeyError, RecursionError):
                continue

    @property
    def mean_s(self) -> float | None:
        """Mean latency so far, warm-up included."""
        return self.total_s / self.ok if self.ok else None


class Lines:
    """One line for each change."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._said: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, event: Event) -> None:
        """Write the line unless the last one of this sample said the same."""
        words = event.what if event.record is None else outcome(event.record)
        words += f": {event.detail}" if event.detail else ""
        if event.record is not None and event.record.state != "ok" and event.folder is not None:
            words += f"; logs: {event.folder}"
        if self._said.get(event.sample.id) != words:
            self._said[event.sample.id] = words
            self._write(f"{event.sample.id} ({machine(event.sample)}) {words}")


class Events:
    """One JSON object a change."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._last: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, event: Event) -> None:
        """Write the object unless it is the same as this sample's last one."""
        facts: dict[str, Any] = {
            "sample": event.sample.id, "event": event.what, "detail": event.detail,
            "logs": None if event.folder is None else str(event.folder),
            "spent_usd": event.spent_usd, "committed_usd": event.committed_usd,
            "record": None if event.record is None else event.record.model_dump(mode="json", exclude_none=True),
        }  # fmt: skip
        text = json.dumps(facts)
        if self._last.get(event.sample.id) != text:
            self._last[event.sample.id] = text
            self._write(text)


def machine(sample: Sample) -> str:
    """How a sample's machine is called."""
    return f"{sample.machine.infra}/{sample.machine.instance}" + (" spot" if sample.machine.spot else "")


def verdict(record: Measured) -> str:
    """State, and the reason where it has one."""
    return record.state if record.reason is None else f"{record.state}, {record.reason.replace('_', ' ')}"


def outcome(record: Measured) -> str:
    """State, and the figures that a person looks for first."""
    words = verdict(record)
    if record.latency is not None:
        words += f": {record.requests} requests, mean {seconds(record.latency.mean)}"
    return f"{words} ({record.detail})" if record.detail else words


def seconds(value: float) -> str:
    """A latency to three figures."""
    return units.format_duration(rounded(value, 3))
