"""Progress of a benchmark: one line or one JSON object per change; `fogspec.bench.live_table` has the table."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, Self

from fogspec.agent.redaction import Secrets
from fogspec.backends.protocol import SampleStatus
from fogspec.base import units
from fogspec.base.files import open_untrusted
from fogspec.base.redaction import redact_files
from fogspec.base.units import rounded
from fogspec.bench.types import Event, EventKind
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured

FINAL = (EventKind.DONE, EventKind.RETRIED, EventKind.UNWANTED)


class ProgressReporter(AbstractContextManager["ProgressReporter"], Protocol):
    """Reports the events of samples."""

    def __call__(self, event: Event) -> None:
        """Report the event."""
        ...


@dataclass(slots=True)
class Tail:
    """Progress of a growing timings file: requests so far and the sum of the successful ones' latencies."""

    offset: int = 0
    requests: int = 0
    ok: int = 0
    total_s: float = 0.0

    def update(self, status: SampleStatus) -> None:
        """Read the file if it is here, else take the machine's own report."""
        if status.timings is not None:
            if self.offset == 0:
                self.requests, self.ok, self.total_s = 0, 0, 0.0
            self.read(status.timings)
        elif (partial := status.so_far) is not None:
            self.requests, self.ok = partial.requests, 0 if partial.mean_s is None else partial.requests
            self.total_s = (partial.mean_s or 0.0) * self.ok

    def read(self, path: Path) -> None:
        """Read the new whole lines."""
        try:
            with open_untrusted(path) as file:
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
    """One line per change."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._last: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, event: Event) -> None:
        """Write the line unless it repeats this sample's last one."""
        text = event.kind if event.record is None else outcome(event.record)
        text += f": {event.detail}" if event.detail else ""
        if event.record is not None and event.record.state != "ok" and event.folder is not None:
            text += f"; logs: {event.folder}"
        if self._last.get(event.sample.id) != text:
            self._last[event.sample.id] = text
            self._write(f"{event.sample.id} ({machine(event.sample)}) {text}")


class Events:
    """One JSON object per change."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._last: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, event: Event) -> None:
        """Write the object unless it repeats this sample's last one."""
        facts: dict[str, Any] = {
            "sample": event.sample.id,
            "event": event.kind,
            "detail": event.detail,
            "logs": None if event.folder is None else str(event.folder),
            "spent_usd": event.spent_usd,
            "committed_usd": event.committed_usd,
            "record": None if event.record is None else event.record.model_dump(mode="json", exclude_none=True),
        }
        text = json.dumps(facts)
        if self._last.get(event.sample.id) != text:
            self._last[event.sample.id] = text
            self._write(text)


@dataclass(slots=True)
class RedactingProgress:
    """Reports events without secrets, which a workload can print anywhere; `folders` has the logs of each sample."""

    reporter: ProgressReporter
    secrets: Secrets
    folders: dict[str, Path] = field(default_factory=dict)

    def __call__(self, event: Event) -> None:
        """Redact the event and the files of an attempt that has ended, and report the event."""
        if event.folder is not None:
            self.folders[event.sample.id] = event.folder
            if event.kind in FINAL:
                redact_files(self.secrets, event.folder)
        detail = None if event.detail is None else self.secrets.redact(event.detail)
        self.reporter(replace(event, detail=detail))


def machine(sample: Sample) -> str:
    """Return the name of a sample's machine."""
    return f"{sample.machine.infra}/{sample.machine.instance}" + (" spot" if sample.machine.spot else "")


def verdict(record: Measured) -> str:
    """Return the state, with the reason if it has one."""
    return record.state if record.reason is None else f"{record.state}, {record.reason.replace('_', ' ')}"


def outcome(record: Measured) -> str:
    """Return the state and the main figures."""
    words = verdict(record)
    if record.latency is not None:
        words += f": {record.requests} requests, mean {seconds(record.latency.mean)}"
    if record.stopped_by == "decided":
        words += ", ended early: too slow to be the choice"
    return f"{words} ({record.detail})" if record.detail else words


def seconds(value: float) -> str:
    """Return a latency with three significant digits."""
    return units.format_duration(rounded(value, 3))
