"""The seams: what a plugin must be able to do. Protocols of at most four methods each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured, Reason
from fogspec.spec.schema import Application


class CatalogSource(Protocol):
    """Where machines and prices come from."""

    def load(self) -> Catalog:
        """The whole catalog; raises `fogspec.base.errors.Outcome` or `Problems` when it cannot be read."""
        ...


class ImageRegistry(Protocol):
    """Where container images come from."""

    def digest(self, name: str) -> str:
        """The digest that an image's name stands for now; raises an FogspecError when that cannot be said."""
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
class Partial:
    """How far a sample is that measures elsewhere: its requests, and the mean of the valid latencies in seconds."""

    requests: int
    mean_s: float | None


@dataclass(frozen=True, slots=True)
class Progress:
    """What is known of a started job.

    `timings` is the file of probe records so far, `so_far` what its machine says where the file is not here yet, `ready`
    whether set-up is over. Once `running` is False,
    everything worth keeping has been fetched into the job's folder, and looking again, from any process, says
    the same. `again` says of a reason whether trying the same once more can help. `lost` means that nothing can be
    said of it: it was never started, or its results are beyond reach; it is measured again. `recorded` is a record made
    elsewhere that takes the place of `timings`, and `billed_s` how long the machine is paid for where that is not the
    time it took just now.
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


class LaunchRefused(Exception):
    """A machine could not be had; `again` says whether trying again soon can help."""

    def __init__(self, reason: Reason, detail: str, *, again: bool = False) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail
        self.again = again


class Unreachable(Exception):
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
        """Start the job; raises `LaunchRefused`. Whether or not it raises, `end` must be called."""
        ...

    def look(self, job: Job) -> Progress:
        """What is known of it now, asked from any process; raises `Unreachable`."""
        ...

    def end(self, job: Job) -> None:
        """End it and everything it started, and verify that nothing is left; idempotent.

        Raises `Unreachable` when that could not be verified.
        """
        ...


@runtime_checkable
class ListsMachines(Protocol):
    """A runner that can find machines whose journal is lost, or is on another host."""

    def strays(self, prefix: str, folder: Path) -> Sequence[str]:
        """Names of jobs that begin with `prefix` and whose machines may be up; raises `Unreachable`.

        `folder` is where this application's attempts are, for runners whose machines are this host.
        """
        ...


@dataclass(frozen=True, slots=True)
class Launch:
    """What a deployer runs: the reviewed task on one machine.

    `name` is unique among all launches ever made and is on disk before `Deployer.start`: it alone must be enough to
    find and end what was started. `task` is the parsed task, `root` the folder that its relative paths are relative
    to, `folder` this launch's own folder for logs and fetched files. What is only looked at or ended needs neither
    machine nor task.
    """

    name: str
    machine: Machine | None
    task: Mapping[str, object]
    root: Path
    folder: Path


@dataclass(frozen=True, slots=True)
class DeploymentStatus:
    """What is known of a launch.

    `starting` until the nodes answer, `ready` while they do; `ended` when a node has ended though its machine may
    still be up; `gone` when there is no machine. `timings` are the latest probe records, whole lines, at most a MiB;
    without `observed` nothing records them any more, and `detail` says why. `address` is where the robot finds it,
    `link` the public half of the cloud's end of their link.
    """

    state: Literal["starting", "ready", "ended", "gone"]
    detail: str | None = None
    address: str | None = None
    ready_s: float | None = None
    timings: bytes = b""
    observed: bool = True
    link: str | None = None


class Deployer(Protocol):
    """Keeps reviewed tasks running, each on a machine of its own."""

    name: str
    poll_s: float

    def start(self, launch: Launch) -> None:
        """Begin to start it; raises `LaunchRefused`. Whether or not it raises, `end` must be called in the end."""
        ...

    def look(self, launch: Launch) -> DeploymentStatus:
        """What is known of it now, asked from any process; raises `Unreachable`.

        Raises `LaunchRefused` once it is known that its machine cannot be had.
        """
        ...

    def end(self, launch: Launch) -> None:
        """End it and verify that nothing is left; idempotent. Raises `Unreachable` when that could not be verified."""
        ...

    def names(self, application: str, state: Path) -> Sequence[str]:
        """Names of all that runs of this application, whoever started it; raises `Unreachable`.

        `state` is the application's folder of live state, for deployers whose machines are this host.
        """
        ...


@dataclass(frozen=True, slots=True)
class LinkEnd:
    """One end of a link: reviewed files by name, and what the nodes at this end see in their environment.

    No file holds a key. What is known only when the machine is up stands in them as a word between two @, which
    `link.sh` replaces on the spot: @CLOUD_ADDRESS@, @KEYS@ (the folder of this end's key), @PEER@ (the other's public half).
    In the environment @LINK@ stands for the folder of the reviewed files.
    """

    files: Mapping[str, str]
    environment: Mapping[str, str]


class Link(Protocol):
    """How robot and cloud are joined: configuration as data; what starts it is `templates/link.sh.j2`.

    `packages` are Debian packages that an end needs, with DISTRO for the ROS 2 distribution; `port` is the one that
    the cloud machine listens on, `protocol` which kind; without a protocol there is no link at all.
    """

    name: str
    protocol: Literal["tcp", "udp"] | None
    port: int
    packages: Sequence[str]

    def end(self, application: Application, side: Literal["cloud", "robot"]) -> LinkEnd:
        """The files and the environment of one end."""
        ...

    def notes(self, application: Application, cloud: str) -> Sequence[str]:
        """What a reviewer must know or do for this link on this cloud."""
        ...

    def opening(self, application: Application, infra: str, address: str) -> str | None:
        """How to open the port of the machine at `address`, where the engine does not; None where nothing is to do."""
        ...
