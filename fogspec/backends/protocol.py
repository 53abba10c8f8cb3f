"""The interface of execution backends, which run jobs: start, poll, stop, list.

A job measures a sample or is a deployment. Both are reviewed work on one machine, started, polled and stopped in the same
way; they differ in the status that a poll returns.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from fogspec.backends.naming import ForeignMachine, Owner
from fogspec.base.errors import CloudError
from fogspec.base.project_files import ProjectFiles
from fogspec.base.redaction import without_secrets
from fogspec.base.text import shell_command
from fogspec.base.units import dollars
from fogspec.catalog.machine import Machine
from fogspec.results.schema import Measured, Reason, ResourceUse, ServerFacts

# What a task may mount, by its path on the machine.
AGENT_FILE = "~/.fogspec/agent.pyz"
SETUP_FILE = "~/.fogspec/setup.sh"
MEASURE_FILE = "~/.fogspec/measure.sh"
DEPLOY_FILE = "~/.fogspec/deploy.sh"
LAUNCH_FILE = "~/.fogspec/launch/cloud.launch.py"
LINK_FOLDER = "~/.fogspec/link"
TARGETS = frozenset({AGENT_FILE, SETUP_FILE, MEASURE_FILE, DEPLOY_FILE, LAUNCH_FILE, LINK_FOLDER})
DEPLOYMENT_IDLE_MINUTES = 30  # of an unused deployment


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What a machine is sent and runs, the same for every backend; paths are relative to the root of the project.

    `mounts` are files and directories by their paths on the machine; `script` is the one of them that runs, with
    `arguments`, and `setup` the command that precedes it on a machine that is not this host. `workdir` is the directory that
    the script runs in, None if it needs none. `secrets` are names of variables; `envs` are variables, None for a value that
    is set at launch. `digests` are those of the reviewed files among the mounts.
    """

    script: str
    arguments: tuple[str, ...] = ()
    setup: tuple[str, ...] = ()
    mounts: Mapping[str, str]
    workdir: str | None = None
    secrets: tuple[str, ...] = ()
    envs: Mapping[str, str | None] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Reviewed work to run on one machine.

    `name` is unique among all jobs ever started and is on disk before `Backend.start`: it alone suffices to find and stop
    the job. It is bound to the `owner`: no job with another's name can be made, so that no backend can touch its machine.

    `task` is the parsed SkyPilot task of the `work`, empty on this host, `root` the directory that relative paths are relative
    to, `directory` this job's own directory for logs and fetched files. `tree` is the snapshot of the files that the machine
    is sent in place of the `workdir`; None sends that as it is. `machine`, `work` and `task` may be absent where the job is
    only polled or stopped.

    A sample's machine shuts itself down after `lifetime_s` seconds, even if its controller has died, and so does that of a
    deployment with an end; without one it has no lifetime. The machine may cost at most `cap_usd_per_hour`, without it its
    own price. `replicate` counts the samples on the same type of machine. `labels` are put on its machine beside the owner's.
    """

    name: str
    owner: Owner
    root: Path
    directory: Path
    work: Work | None = None
    task: Mapping[str, object] = field(default_factory=dict)
    tree: Path | None = None
    machine: Machine | None = None
    lifetime_s: float | None = None
    cap_usd_per_hour: float | None = None
    replicate: int = 1
    labels: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise ForeignMachine for a name that is not one of the owner's."""
        if not self.owner.has(self.name):
            raise ForeignMachine([self.name], self.owner, "its record")

    @property
    def files(self) -> ProjectFiles:
        """Opens and writes what is in `directory`."""
        return ProjectFiles(self.root)

    @property
    def launched(self) -> Mapping[str, object]:
        """The task with the snapshot as its `workdir`."""
        if self.tree is None or "workdir" not in self.task:
            return self.task
        return {**self.task, "workdir": str(self.tree.absolute())}

    @property
    def machine_name(self) -> str:
        """The infra and instance type of its machine."""
        return "" if self.machine is None else f"{self.machine.infra}/{self.machine.instance}"


@dataclass(frozen=True, slots=True)
class Partial:
    """The progress of a sample that is measured elsewhere: its requests, and the mean of the valid latencies in seconds."""

    requests: int
    mean_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleStatus:
    """The status of a sample.

    `ready` is False during set-up. `timings` is the file of probe records so far; `so_far` is the machine's own report while
    that file is not here yet. Once `running` is False, everything worth keeping is in the job's directory, and every later
    poll, from any process, returns the same. `again` tells whether a retry can help. `lost` means that the outcome is unknown:
    the job was never started, or its results are out of reach; the sample is measured again. `recorded` is a record made
    elsewhere that replaces `timings`. `billed_s` is the billed time if that is not the elapsed time, and 0 only where it is
    certain that there was no machine.
    """

    running: bool
    timings: Path | None = None
    reason: Reason | None = None
    detail: str | None = None
    ready: bool = True
    again: bool = False
    lost: bool = False
    measured_on: str = ""
    setup_s: float | None = None
    measured_s: float | None = None
    stopped_by: str | None = None
    waited_s: float | None = None
    billed_s: float | None = None
    recorded: Measured | None = None
    so_far: Partial | None = None
    server: ServerFacts | None = None
    resources: ResourceUse | None = None

    def __post_init__(self) -> None:
        """Take secrets out of the machine's words."""
        _without_secrets(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeploymentStatus:
    """The status of a deployment.

    `starting` until the nodes answer, `ready` while they do; `ended` when a node has ended though its machine may
    still be up; `gone` when there is no machine. `timings` are the latest probe records, whole lines, at most a MiB.
    `observed` is False when nothing records them any more, and `detail` gives the reason. `address` is where the robot finds
    the machine, `link` the public half of the cloud's end of their link, `server` the machine's facts about itself.
    `packages` is the list of its packages, None where it was not reported.
    `restarts` is how often the machine started a node again, for each node that has `respawn`. `clock_s` is what
    time it was by the clock of the timings when the machine reported.
    """

    state: Literal["starting", "ready", "ended", "gone"]
    detail: str | None = None
    address: str | None = None
    ready_s: float | None = None
    timings: bytes = b""
    observed: bool = True
    link: str | None = None
    server: ServerFacts | None = None
    packages: str | None = None
    restarts: Mapping[str, int] = field(default_factory=dict)
    clock_s: float | None = None

    def __post_init__(self) -> None:
        """Take secrets out of the machine's words."""
        _without_secrets(self)


def _without_secrets(status: SampleStatus | DeploymentStatus) -> None:
    if status.detail is not None:
        object.__setattr__(status, "detail", without_secrets(status.detail))


class LaunchRefused(Exception):
    """A machine is unavailable; `again` tells whether a retry can help soon."""

    def __init__(self, reason: Reason, detail: str, *, again: bool = False) -> None:
        self.detail = without_secrets(detail)
        super().__init__(self.detail)
        self.reason = reason
        self.again = again


class Unreachable(Exception):
    """A backend cannot find out the state of a job just now; a later attempt may succeed."""

    def __init__(self, detail: object = "") -> None:
        super().__init__(without_secrets(str(detail)))


class NoAnswer(CloudError):
    """It cannot be found out just now whether a backend has access to a cloud."""


StatusT = TypeVar("StatusT", covariant=True)


def no_access(
    detail: str, clouds: Collection[str] = (), booked_usd: float = 0.0, *, verified: bool = True
) -> CloudError:
    """Return the error of a command that cannot have any machine, and what to do about it.

    `booked_usd` is the cost of machines that had been started when access was lost. Without access it may not be `verified`
    that none is left.
    """
    cost = f"its machine cost {dollars(booked_usd)} until access was lost, and no sample was recorded for it"
    if not verified:
        cost = "whether a machine was started cannot be verified without access; no sample was recorded for it"
    again = shell_command("sky", "check", *clouds) + " says why; log in to the cloud, then run the same command again"
    if "forbidden" in detail.lower():  # Kubernetes knows the user, and refuses
        again = "ask for this right in the namespace, then run the same command again: kubectl auth can-i create pods"
    return CloudError(
        f"SkyPilot cannot start a machine: {detail}",
        cost if booked_usd or not verified else "nothing was started, recorded or paid for it",
        again,
    )


class Backend(Protocol[StatusT]):
    """Runs jobs of one kind. `name` is written into results and live state; `poll_s` is a useful polling interval."""

    name: str
    poll_s: float

    def start(self, job: Job) -> None:
        """Start the job; raise LaunchRefused if its machine is unavailable. In either case `stop` must be called in the end."""
        ...

    def poll(self, job: Job) -> StatusT:
        """Return the job's status, from any process; raise Unreachable.

        Raise LaunchRefused for a deployment once it is known that its machine is unavailable.
        """
        ...

    def stop(self, job: Job) -> int | None:
        """Stop the job and everything it started, and verify that nothing is left; idempotent.

        Raise Unreachable if that could not be verified. Return how many machines there were, or None if the provider does not
        say: each is paid, even if its launch failed.
        """
        ...

    def check_access(self, places: Collection[str]) -> None:
        """Raise CloudError if no machine is available in one of these places, before any is requested: each is an `infra`.

        It is a NoAnswer if that cannot be found out.
        """
        ...

    def list(self, owner: Owner, directory: Path) -> Sequence[str]:
        """Return the names of the owner's jobs that may be running, by whatever process started; raise Unreachable.

        `directory` contains the directories of those jobs, for backends whose machines are this host.
        """
        ...


class Costs(StrEnum):
    """The money that a sample costs: real money, what was recorded when it was measured, or nothing."""

    REAL = "real"
    RECORDED = "recorded"
    NOTHING = "nothing"


class SampleBackend(Backend[SampleStatus], Protocol):
    """Measures samples. No method blocks longer than a few seconds.

    `source` describes the validity of the figures in one sentence, where that is needed; `notes` are lines for who starts a
    bench: which limits hold, what the nodes are given. `at_once` is the largest number of
    jobs at the same time.
    """

    @property
    def source(self) -> str | None:
        """What the figures are valid for, in one sentence."""
        ...

    at_once: int
    costs: Costs
    notes: tuple[str, ...]


class DeploymentBackend(Backend[DeploymentStatus], Protocol):
    """Keeps deployments running."""

    def check_access(self, places: Collection[str], briefly: bool = False) -> None:
        """Do as for any backend; if `briefly`, end a server on this computer that it starts for that."""
        ...

    def close(self) -> None:
        """End the process on this computer that reaches machines, if there is one; the next call starts it again."""
        ...

    def labels(self, job: Job) -> Mapping[str, str]:
        """Return the labels that the job's machine was started with, by whatever process; raise Unreachable."""
        ...

    def read_log(self, job: Job) -> bytes:
        """Return the end of what the job has printed, as its machine keeps it; raise Unreachable.

        Nothing where nothing was printed yet, or where the machine is gone.
        """
        ...
