"""What a campaign is to do, whom it tells what happens, and where its records go."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fogspec.backends.protocol import Progress
from fogspec.bench.record import Rules
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured

SAMPLE_IN_NAME = 30


@dataclass(frozen=True, slots=True)
class CampaignConfig:
    """What a campaign is to do. `application` is a digest of what is measured.

    `task` gives a sample's reviewed task, parsed, or None when the sample is not asked for; `instead` gives samples
    to measure where the one with this id cannot be had, those to be tried first in front. A sample is ended by its
    controller after `deadline_s`, and by itself after `lifetime_s`. Names of machines begin with `prefix`; `token`
    makes those of this campaign differ from all others, also when the journal is gone.
    """

    application: str
    rules: Rules
    budget_usd: float | None
    deadline_s: float
    lifetime_s: float
    task: Callable[[Sample], Mapping[str, object] | None]
    root: Path
    attempts: Path
    prefix: str
    token: str
    instead: Callable[[str], Sequence[Sample]] = lambda _sample: ()

    def name(self, sample: Sample, number: int) -> str:
        """The name of the campaign's attempt with this number."""
        return f"{self.prefix}{sample.id[:SAMPLE_IN_NAME]}-{self.token}-{number}"


@dataclass(frozen=True, slots=True)
class Queued:
    """A sample that is to be started, `not_before_s` by the campaign's clock, perhaps in the place of another."""

    sample: Sample
    not_before_s: float = 0.0
    substitute_for: str | None = None


@dataclass(frozen=True, slots=True)
class Event:
    """What happens to a sample now, for whoever watches, and what the campaign has spent.

    `folder` has the logs of the attempt, `ends_s` is when it is ended at the latest, by the campaign's clock.
    """

    sample: Sample
    what: str
    spent_usd: float
    committed_usd: float
    progress: Progress | None = None
    record: Measured | None = None
    detail: str | None = None
    folder: Path | None = None
    ends_s: float | None = None


class ResultsSink(Protocol):
    """Where records go."""

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Keep the raw timings safe and name them in the record."""
        ...

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the results with this record in place; `spent_usd` is what all of them cost."""
        ...

    def paid(self, spent_usd: float) -> None:
        """Write what all of it cost, where a machine was paid for and left no record."""
        ...
