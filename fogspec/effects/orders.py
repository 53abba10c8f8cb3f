"""What a campaign is to do, whom it tells what happens, and where its records go."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fogspec.effects import collecting
from fogspec.plan import Sample
from fogspec.results import Measured
from fogspec.seams import Progress


@dataclass(frozen=True, slots=True)
class Order:
    """What a campaign is to do. Digests name what is measured; `tasks` are the reviewed tasks, parsed.

    A sample is ended by its controller after `deadline_s`, and by itself after `lifetime_s`. `token` makes the
    names of this campaign's machines differ from all others', also when the journal is gone.
    """

    application: str
    plan: str
    rules: collecting.Rules
    budget_usd: float | None
    deadline_s: float
    lifetime_s: float
    tasks: Mapping[str, Mapping[str, object]]
    root: Path
    attempts: Path
    token: str


@dataclass(frozen=True, slots=True)
class Event:
    """What happens to a sample now, for whoever watches, and what the campaign has spent."""

    sample: Sample
    what: str
    spent_usd: float
    committed_usd: float
    progress: Progress | None = None
    record: Measured | None = None
    detail: str | None = None


class Ledger(Protocol):
    """Where records go."""

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Keep the raw timings safe and name them in the record."""
        ...

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the results with this record in place; `spent_usd` is what all of them cost."""
        ...
