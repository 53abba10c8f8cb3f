"""The configuration of a campaign, its events, and the interface of its results."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import SampleStatus, Work
from fogspec.base.text import shell_command
from fogspec.plan.commitment import Commitment
from fogspec.plan.schema import Sample
from fogspec.results.requests import RecordRules
from fogspec.results.schema import Measured

SAMPLE_IN_NAME = 30


def measuring(runner: str) -> str:
    """Return the command that measures with a runner; one that replays is the lab's."""
    if runner == "replay":
        return shell_command("fogspec-lab", "replay", "APP", "--from", "FILE")
    return shell_command("fogspec", "bench", "APP", "--runner", runner)


@dataclass(frozen=True, slots=True)
class SampleTask:
    """What measures one sample, and the parsed SkyPilot task that has a machine do it; empty on this host."""

    work: Work
    task: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignConfig:
    """The configuration of a campaign. `owner` is whose machines it starts, `measured` a digest of what is measured.

    `tree` is the snapshot of the files that each machine is sent, None for none.
    `task` returns what measures a sample, as it was reviewed, or None if the sample is no longer wanted. `commitment` has
    the times of each sample's machine. `token` makes the names of this campaign's jobs differ from all others, also when
    the journal is lost.
    """

    owner: Owner
    measured: str
    rules: RecordRules
    budget_usd: float | None
    commitment: Commitment
    task: Callable[[Sample], SampleTask | None]
    root: Path
    attempts: Path
    token: str
    tree: Path | None = None

    def job_name(self, sample: Sample, number: int) -> str:
        """Return the name of the campaign's attempt with this number."""
        return f"{self.owner.prefix}{sample.id[:SAMPLE_IN_NAME]}-{self.token}-{number}"


@dataclass(frozen=True, slots=True)
class Queued:
    """A sample to start, not before `not_before_s` of the campaign's clock."""

    sample: Sample
    not_before_s: float = 0.0


class EventKind(StrEnum):
    """The kinds of events of a sample, as progress output spells them."""

    STARTS = "starts"
    SETS_UP = "sets up"
    MEASURES = "measures"
    LOST_CONTACT = "lost contact"
    ENDS = "ends"
    RETRIED = "is tried again"
    UNWANTED = "is no longer wanted"
    DONE = "is done"
    NOT_ENDED = "cannot be ended"


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """An event of a sample, with what the campaign has spent.

    `folder` has the logs of the attempt, `ends_s` is when it is stopped at the latest, by the campaign's clock.
    """

    sample: Sample
    kind: EventKind
    spent_usd: float
    committed_usd: float
    status: SampleStatus | None = None
    record: Measured | None = None
    detail: str | None = None
    folder: Path | None = None
    ends_s: float | None = None


class ResultsSink(Protocol):
    """The destination of records."""

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Keep the raw timings, and return the record with a reference to them."""
        ...

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the results with this record; `spent_usd` is the cost of all of them."""
        ...

    def paid(self, sample: Sample, spent_usd: float) -> None:
        """Write the cost of all of them after a machine was paid for that left no record of its sample."""
        ...
