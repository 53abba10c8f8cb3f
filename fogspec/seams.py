"""The seams: what a plugin must be able to do. Protocols of at most three methods each."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from fogspec.catalog import Catalog
from fogspec.plan import Sample
from fogspec.results import Measured, Reason


class CatalogSource(Protocol):
    """Where machines and prices come from."""

    def load(self) -> Catalog:
        """The whole catalog; raises `fogspec.base.outcomes.Outcome` or `Problems` when it cannot be read."""
        ...


class ImageRegistry(Protocol):
    """Where container images come from."""

    def digest(self, name: str) -> str:
        """The digest that an image's name stands for now; raises an Outcome when that cannot be said."""
        ...


@dataclass(frozen=True, slots=True)
class Job:
    """What a runner runs: the compiled task as it was reviewed, never the plan.

    `name` is unique among all attempts ever made and is journaled before `Runner.start`: it alone must be
    enough to find and end what was started. `task` is the parsed task, `root` the folder that the task's
    relative paths are relative to, `folder` this attempt's own folder for logs and fetched files. After
    `lifetime_s` seconds the machine ends by itself, whatever became of whoever started it.
    """

    name: str
    sample: Sample
    task: Mapping[str, object]
    root: Path
    folder: Path
    lifetime_s: float


@dataclass(frozen=True, slots=True)
class Progress:
    """What is known of a started job.

    `timings` is the file of probe records so far, `ready` whether set-up is over. Once `running` is False,
    everything worth keeping has been fetched into the job's folder, and looking again, from any process, says
    the same. `lost` means that nothing can be said of it: it was never started, or its results are beyond
    reach; it is measured again. `recorded` is a record made elsewhere that takes the place of `timings`, and
    `billed_s` how long the machine is paid for where that is not the time it took just now.
    """

    running: bool
    timings: Path | None = None
    reason: Reason | None = None
    detail: str | None = None
    ready: bool = True
    lost: bool = False
    measured_on: str = ""
    setup_s: float | None = None
    measured_s: float | None = None
    stopped_by: str | None = None
    waited_s: float | None = None
    billed_s: float | None = None
    recorded: Measured | None = None


@dataclass(frozen=True, slots=True)
class Recording:
    """One record to be replayed, and its raw timings where they were kept (gzip)."""

    record: Measured
    timings: Path | None = None


class CannotStart(Exception):
    """A machine could not be had; `again` says whether trying again soon can help."""

    def __init__(self, reason: Reason, detail: str, *, again: bool = False) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail
        self.again = again


class LostContact(Exception):
    """A runner cannot tell just now what became of a job; asking again later may help."""


class Runner(Protocol):
    """Runs samples. No method blocks longer than a few seconds.

    `name` is written into results; `source` says in one sentence what the figures are worth, where that needs
    saying; `at_once` is how many jobs may run at the same time, `poll_s` how often looking is worth while.
    `costs`: real money, what was recorded when it was measured, or nothing.
    """

    name: str
    source: str | None
    at_once: int
    poll_s: float
    costs: Literal["real", "recorded", "nothing"]

    def start(self, job: Job) -> None:
        """Start the job; raises `CannotStart`. Whether or not it raises, `end` must be called."""
        ...

    def look(self, job: Job) -> Progress:
        """What is known of it now, asked from any process; raises `LostContact`."""
        ...

    def end(self, job: Job) -> None:
        """End it and everything it started, and verify that nothing is left; idempotent.

        Raises `LostContact` when that could not be verified.
        """
        ...
