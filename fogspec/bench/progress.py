"""Progress of a benchmark: one line or one JSON object per change; `fogspec.bench.live_table` has the table."""

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

from fogspec.backends.protocol import SampleStatus
from fogspec.base import units
from fogspec.base.files import open_untrusted
from fogspec.base.quantities import as_numbers
from fogspec.base.text import count
from fogspec.base.units import dollars
from fogspec.bench.types import Event, EventKind
from fogspec.plan.schema import Sample
from fogspec.results.resources import contended
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


class Totals:
    """Progress of a whole bench; `more` says that samples may follow that are not planned yet.

    The time left is estimated from the samples that this bench has finished, and from how many it ran at once.
    """

    def __init__(
        self, samples: Sequence[Sample], budget_usd: float | None, now_s: Callable[[], float], more: bool = False
    ) -> None:
        self._planned = {sample.id for sample in samples}
        self._budget_usd, self._now_s, self._more = budget_usd, now_s, more
        self._done: set[str] = set()
        self._began: dict[str, float] = {}
        self._took_s: list[float] = []
        self._at_once = 0
        self._money = ""

    def take(self, event: Event) -> None:
        """Count the event."""
        name = event.sample.id
        self._planned.add(name)
        if event.kind is EventKind.STARTS:
            self._done.discard(name)
            self._began[name] = self._now_s()
            self._at_once = max(self._at_once, len(self._began))
        elif event.kind in FINAL:
            began = self._began.pop(name, None)
            if event.kind is EventKind.UNWANTED:
                self._planned.discard(name)
            elif event.kind is EventKind.DONE:
                self._done.add(name)
                if began is not None:
                    self._took_s.append(self._now_s() - began)
        of = "" if self._budget_usd is None else f" of {dollars(self._budget_usd)}"
        committed = f", committed at most {dollars(event.committed_usd)}" if event.committed_usd else ""
        self._money = f"; spent {dollars(event.spent_usd)}{of}{committed}"

    @property
    def left_s(self) -> float | None:
        """Seconds until all planned samples are done, if they take as long as those before; None before one is."""
        if not self._took_s:
            return None
        each_s, now_s = sum(self._took_s) / len(self._took_s), self._now_s()
        running_s = sum(max(each_s - (now_s - began), 0.0) for began in self._began.values())
        waiting = len(self._planned - self._done - self._began.keys())
        return (running_s + each_s * waiting) / max(self._at_once, 1)

    @property
    def counts(self) -> tuple[int, int]:
        """How many samples are done, and how many are planned so far."""
        return len(self._done), len(self._planned)

    def line(self) -> str:
        """Return the totals in one line, and what the time left rests on."""
        done, planned = self.counts
        text = f"{done} of {count(planned, 'sample')} done{', more may follow' if self._more else ''}{self._money}"
        left_s = self.left_s
        if done >= planned:
            return text
        if left_s is None:
            return f"{text}; time left: not known yet"
        each = units.shown_duration(sum(self._took_s) / len(self._took_s), 2)
        basis = f"{count(len(self._took_s), 'sample')} took {each}{' each' if len(self._took_s) > 1 else ''}"
        return f"{text}; about {units.shown_duration(left_s, 2)} left, as {basis}"


class Lines:
    """One line per change, and the totals whenever a sample is done."""

    def __init__(self, write: Callable[[str], None], totals: Totals | None = None) -> None:
        self._write, self._totals = write, totals
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
        if self._totals is not None:
            self._totals.take(event)
            if event.kind is EventKind.DONE:
                self._write(self._totals.line())


class Events:
    """One object per change, with the totals, to be written as JSON."""

    def __init__(self, write: Callable[[dict[str, Any]], None], totals: Totals | None = None) -> None:
        self._write, self._totals = write, totals
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
            "record": None if event.record is None else as_numbers(event.record),
        }
        text = json.dumps(facts)
        if self._totals is not None:
            self._totals.take(event)
            done, planned = self._totals.counts
            facts |= {"samples_done": done, "samples_planned": planned, "left_s": self._totals.left_s}
        if self._last.get(event.sample.id) != text:
            self._last[event.sample.id] = text
            self._write(facts)


def machine(sample: Sample) -> str:
    """Return the name of a sample's machine."""
    return f"{sample.machine.infra}/{sample.machine.instance}" + (" spot" if sample.machine.spot else "")


def verdict(record: Measured) -> str:
    """Return the state, with the reason if it has one."""
    more = record.reason or ("contended" if record.state == "ok" and contended(record) else None)
    return record.state if more is None else f"{record.state}, {more.replace('_', ' ')}"


def outcome(record: Measured, statistic: str = "mean") -> str:
    """Return the state and the main figures, the `statistic` among them."""
    words = verdict(record)
    if record.latency is not None:
        words += f": {count(record.requests, 'request')}, mean {seconds(record.latency.mean)}"
        if statistic != "mean" and (value := getattr(record.latency, statistic)) is not None:
            words += f", {statistic} {seconds(value)}"
    if record.stopped_by == "decided":
        words += ", ended early: too slow to be the choice"
    return f"{words} ({record.detail})" if record.detail else words


def seconds(value: float) -> str:
    """Return a latency with three significant digits."""
    return units.shown_duration(value)
