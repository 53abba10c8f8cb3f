"""Live progress table, refreshed at 4 Hz."""

from collections.abc import Callable, Sequence
from typing import Self

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fogspec.base.console import live_console
from fogspec.base.text import line
from fogspec.base.units import shown_duration
from fogspec.bench.progress import Tail, Totals, machine, seconds, verdict
from fogspec.bench.types import Event, EventKind
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured

WIDE = 100
COLUMNS = ("sample", "machine", "state", "requests", "mean so far", "time", "left")


class LiveTable:
    """A row per sample; later samples get theirs when they start. Requests are counted after the warm-up.

    A narrow terminal has no column for the machine, after which a sample is named.
    """

    def __init__(self, samples: Sequence[Sample], steps: int | None, budget_usd: float | None,
                 now_s: Callable[[], float], console: Console | None = None, warmup: int = 0,
                 more: bool = False) -> None:  # fmt: skip
        self._samples = {sample.id: sample for sample in samples}
        self._steps, self._now_s, self._warmup = steps, now_s, warmup
        self._totals = Totals(samples, budget_usd, now_s, more)
        self._console = console or live_console()
        self._state: dict[str, str] = {}
        self._tails: dict[str, Tail] = {}
        self._began: dict[str, float] = {}
        self._ends: dict[str, float] = {}
        self._records: dict[str, Measured] = {}
        self._live = Live(console=self._console, get_renderable=self.table, refresh_per_second=4, transient=True)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def __call__(self, event: Event) -> None:
        """Take the event for the next refresh."""
        name = event.sample.id
        self._samples.setdefault(name, event.sample)
        self._state[name] = event.kind if event.record is None else verdict(event.record)
        if event.kind is EventKind.STARTS:
            self._began[name], self._tails[name] = self._now_s(), Tail()
            self._records.pop(name, None)
        if event.ends_s is not None:
            self._ends[name] = event.ends_s
        if event.status is not None:
            self._began.setdefault(name, self._now_s())
            self._tails.setdefault(name, Tail()).update(event.status)
        if event.record is not None:
            self._records[name] = event.record
        self._totals.take(event)

    def table(self) -> Table:
        """Return the table as of now."""
        table = Table(box=box.SIMPLE, caption=self._totals.line(), caption_justify="left")
        shown = [n for n, title in enumerate(COLUMNS) if title != "machine" or self._console.width >= WIDE]
        for n in shown:
            table.add_column(COLUMNS[n], no_wrap=n == 0)
        for sample in list(self._samples.values()):
            row = self._row(sample)
            table.add_row(*(Text(line(row[n])) for n in shown))
        return table

    def _row(self, sample: Sample) -> list[str]:
        name, now_s = sample.id, self._now_s()
        tail, record = self._tails.get(name, Tail()), self._records.get(name)
        count, mean_s = max(tail.requests - self._warmup, 0), tail.mean_s
        took = now_s - self._began[name] if name in self._began else None
        left = max(self._ends[name] - now_s, 0.0) if name in self._ends else None
        if record is not None:
            count, mean_s = record.requests, None if record.latency is None else record.latency.mean
            took, left = record.duration, None
        return [
            name, machine(sample), self._state.get(name, "waits"),
            f"{count}{'' if self._steps is None else f' of {self._steps}'}" if count else "",
            "" if mean_s is None else seconds(mean_s), "" if took is None else shown_duration(round(took)),
            "" if left is None else f"at most {shown_duration(round(left))}",
        ]  # fmt: skip
