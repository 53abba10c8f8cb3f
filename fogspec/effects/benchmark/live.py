"""A benchmark on a terminal: a table that is drawn anew four times a second, whatever the events do."""

from collections.abc import Callable, Sequence
from typing import Self

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fogspec.effects.benchmark.orders import Event
from fogspec.effects.benchmark.watching import Tail, machine, money, outcome, seconds
from fogspec.plan import Sample

COLUMNS = ("sample", "machine", "state", "requests", "mean so far", "time", "left")


class LiveTable:
    """Samples that are asked for later get a row when they start."""

    def __init__(self, samples: Sequence[Sample], steps: int | None, budget_usd: float | None,
                 now_s: Callable[[], float], console: Console | None = None) -> None:  # fmt: skip
        self._samples = {sample.id: sample for sample in samples}
        self._steps, self._budget_usd, self._now_s = steps, budget_usd, now_s
        self._state: dict[str, str] = {}
        self._tails: dict[str, Tail] = {}
        self._began: dict[str, float] = {}
        self._ends: dict[str, float] = {}
        self._took: dict[str, float] = {}
        self._money = ""
        self._live = Live(
            console=console or Console(stderr=True), get_renderable=self.table, refresh_per_second=4, transient=True
        )

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def __call__(self, event: Event) -> None:
        """Remember it for the next drawing."""
        name = event.sample.id
        self._samples.setdefault(name, event.sample)
        self._state[name] = event.what if event.record is None else outcome(event.record)
        if event.what == "starts":
            self._began[name], self._tails[name] = self._now_s(), Tail()
            self._took.pop(name, None)
        if event.ends_s is not None:
            self._ends[name] = event.ends_s
        if event.progress is not None:
            self._began.setdefault(name, self._now_s())
            self._tails.setdefault(name, Tail()).take(event.progress)
        if event.record is not None:
            self._took[name] = event.record.duration
        of = "" if self._budget_usd is None else f" of {money(self._budget_usd)}"
        self._money = f"spent {money(event.spent_usd)}{of}, committed at most {money(event.committed_usd)}"

    def table(self) -> Table:
        """What is known now."""
        table = Table(box=box.SIMPLE, caption=self._money)
        for title in COLUMNS:
            table.add_column(title)
        for sample in list(self._samples.values()):
            table.add_row(*map(Text, self._row(sample)))
        return table

    def _row(self, sample: Sample) -> list[str]:
        name, now_s = sample.id, self._now_s()
        tail = self._tails.get(name, Tail())
        took = self._took.get(name, now_s - self._began[name] if name in self._began else None)
        left = None if name in self._took or name not in self._ends else max(self._ends[name] - now_s, 0.0)
        requests = f"{tail.requests}" + ("" if self._steps is None else f" of {self._steps}")
        return [
            name, machine(sample), self._state.get(name, "waits"), requests if tail.requests else "",
            "" if tail.mean_s is None else seconds(tail.mean_s), "" if took is None else f"{took:.0f} s",
            "" if left is None else f"at most {left:.0f} s",
        ]  # fmt: skip
