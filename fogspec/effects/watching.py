"""Showing a benchmark while it runs: a live table on a terminal, one line a change elsewhere, or JSON events."""

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

from fogspec.base import units
from fogspec.effects.orders import Event
from fogspec.plan import Sample
from fogspec.results import Measured

if TYPE_CHECKING:
    from rich.table import Table


class Watcher(AbstractContextManager["Watcher"], Protocol):
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

    def read(self, path: Path | None) -> None:
        """Take in what is new, whole lines only."""
        if path is None or not path.is_file():
            return
        with open(path, "rb") as file:
            file.seek(self.offset)
            new = file.read(2**20)
        whole = new.rfind(b"\n") + 1
        self.offset += whole
        for line in new[:whole].splitlines():
            try:
                record = json.loads(line)
                self.requests += 1
                if record["ok"] is True:
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
            "spent_usd": event.spent_usd, "committed_usd": event.committed_usd,
            "record": None if event.record is None else event.record.model_dump(mode="json", exclude_none=True),
        }  # fmt: skip
        text = json.dumps(facts)
        if self._last.get(event.sample.id) != text:
            self._last[event.sample.id] = text
            self._write(text)


class LiveTable:
    """A table that is drawn anew four times a second."""

    def __init__(self, samples: Sequence[Sample], steps: int | None, budget_usd: float | None,
                 now_s: Callable[[], float]) -> None:  # fmt: skip
        from rich.console import Console
        from rich.live import Live

        self._samples, self._steps, self._budget_usd, self._now_s = samples, steps, budget_usd, now_s
        self._state: dict[str, str] = {}
        self._tails: dict[str, Tail] = {}
        self._began: dict[str, float] = {}
        self._took: dict[str, float] = {}
        self._money = ""
        self._live: Live = Live(
            console=Console(stderr=True), get_renderable=self._table, refresh_per_second=4, transient=True
        )

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def __call__(self, event: Event) -> None:
        """Remember it for the next drawing."""
        name = event.sample.id
        self._state[name] = event.what if event.record is None else outcome(event.record)
        if event.what == "starts":
            self._began[name], self._tails[name] = self._now_s(), Tail()
        if event.progress is not None:
            self._began.setdefault(name, self._now_s())
            self._tails.setdefault(name, Tail()).read(event.progress.timings)
        if event.record is not None:
            self._took[name] = event.record.duration
        of = "" if self._budget_usd is None else f" of {money(self._budget_usd)}"
        self._money = f"spent {money(event.spent_usd)}{of}, committed at most {money(event.committed_usd)}"

    def _table(self) -> "Table":
        from rich import box
        from rich.table import Table
        from rich.text import Text

        table = Table(box=box.SIMPLE, caption=self._money)
        for title in ("sample", "machine", "state", "requests", "mean so far", "time"):
            table.add_column(title)
        for sample in self._samples:
            name = sample.id
            tail = self._tails.get(name, Tail())
            took = self._took.get(name, self._now_s() - self._began[name] if name in self._began else None)
            steps = f"{tail.requests}" + ("" if self._steps is None else f" of {self._steps}")
            cells = [name, machine(sample), self._state.get(name, "waits"), steps if tail.requests else "",
                     "" if tail.mean_s is None else seconds(tail.mean_s), "" if took is None else f"{took:.0f} s"]  # fmt: skip
            table.add_row(*map(Text, cells))
        return table


def machine(sample: Sample) -> str:
    """How a sample's machine is called."""
    return f"{sample.machine.infra}/{sample.machine.instance}" + (" spot" if sample.machine.spot else "")


def outcome(record: Measured) -> str:
    """State, and the figures that a person looks for first."""
    words = record.state if record.reason is None else f"{record.state}, {record.reason.replace('_', ' ')}"
    if record.latency is not None:
        words += f": {record.requests} requests, mean {seconds(record.latency.mean)}"
    return f"{words} ({record.detail})" if record.detail else words


def seconds(value: float) -> str:
    """A latency to three figures."""
    return units.format_duration(float(f"{value:.3g}"))


def money(usd: float) -> str:
    """Dollars, to a hundredth of a cent where that matters."""
    return f"${usd:.2f}" if usd >= 1 or usd == 0 else f"${usd:.4f}"
