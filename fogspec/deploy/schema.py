"""The live state of an application: written before anything is started, so that no machine is ever lost."""

import re
from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from fogspec.base.digest import shorten
from fogspec.base.quantities import Duration, Id, Money, Strict
from fogspec.base.units import dollars, shown_price
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import EnvironmentMetadata


def _date(text: str) -> str:
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("a date says its time zone")
    return text


class Place(Strict):
    """The computer on which a machine of the local runner runs, and the project's folder there."""

    host: str
    root: str


class Applied(Strict):
    """The apply that a machine serves.

    `generation` counts them. `commit` is HEAD of the checkout, `actor` the user of CI or
    git's `user.name`; None without git. `date` is in UTC.
    """

    generation: int
    commit: Annotated[str, Field(pattern=r"^[0-9a-f]{40,64}$")] | None = None
    actor: str | None = None
    date: Annotated[str, AfterValidator(_date)]

    @property
    def text(self) -> str:
        """The apply in words."""
        commit = f"commit {self.commit[:12]}, " if self.commit else ""
        by = f" by {self.actor}" if self.actor else ""
        return f"{commit}applied {self.date}{by}, generation {self.generation}"


class Act(Strict):
    """What a command did with a machine, `name`: it `started` it, `kept` it under another manifest, or `ended` it.

    `by` is the apply that the machine serves, for its end who ended it from which commit, each with the date of the act.
    `price` is in USD per hour, `spent` what the machine had cost at its end; of one that was found by its name alone, neither
    is known, nor its `machine`, its `manifest` and its generation, which is 0.
    """

    verb: str
    did: Literal["started", "kept", "ended"]
    by: Applied
    name: Id
    machine: str | None = None
    manifest: str | None = None
    price: Money | None = None
    spent: Money | None = None

    @property
    def text(self) -> str:
        """The act in words."""
        cost = "" if self.spent is None else f", {dollars(self.spent)}"
        what = f"{self.name}, found by its name"
        if self.machine is not None and self.manifest is not None and self.price is not None:
            digest = shorten(self.manifest, 12)
            what = f"{self.machine} at {shown_price(self.price)}{cost}, {self.name}, manifest {digest}"
        commit = f", commit {self.by.commit[:12]}" if self.by.commit else ""
        actor = f" by {self.by.actor}" if self.by.actor else ""
        generation = f", generation {self.by.generation}" if self.by.generation else ""
        return f"{self.by.date} {self.verb}{actor} {self.did} {what}{commit}{generation}"


class DeployedMachine(Strict):
    """One machine that was started, or was about to be.

    `starting` until its nodes have answered once, then `serving`; `ending` when it is to go. `manifest` is the digest
    of the manifest that it was started for, `image` the one it runs where it has one, `fallback` counts how many
    machines before it in that manifest could not be had. `runs` is the digest of all that the machine is given, `files`
    the digests of the files and folders beside the spec among that, None if they are unknown. `place` is where a process of
    this host runs, if clones share the state. `ends` is the date in UTC at which it ends by itself.
    `at` is the reading, in seconds, of this host's clock since its `boot`; `since` is the date in UTC.
    """

    name: Id
    deployer: str
    state: Literal["starting", "serving", "ending"]
    manifest: str
    machine: Machine
    runs: str
    files: dict[str, str] | None
    place: Place | None = None
    fallback: int = 0
    image: str | None = None
    address: str | None = None
    at: Duration
    boot: str
    since: Annotated[str, AfterValidator(_date)]
    ends: Annotated[str, AfterValidator(_date)] | None = None
    applied: Applied | None = None

    def up_s(self, now_s: float, boot: str, today: datetime) -> float:
        """Return the seconds since its start: by the monotonic clock, or over a restart of this host by the date."""
        if self.boot == boot:
            return max(0.0, now_s - self.at)
        return max(0.0, (today - datetime.fromisoformat(self.since)).total_seconds())


class DeploymentBody(Strict):
    """The machines, and the cost of those that are gone since the application was last down.

    `history` has what the latest commands did with machines, the oldest first; it stays when nothing runs any more.
    """

    machines: list[DeployedMachine]
    spent: Money = 0.0
    history: list[Act] = Field(default_factory=list)


class LiveState(Strict):
    """`kind: LiveState`: `.fogspec/NAME/deployment.yaml`."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["LiveState"] = "LiveState"
    metadata: EnvironmentMetadata
    spec: DeploymentBody


class Lease(Strict):
    """The command that works on an application now; no other one may until it has ended, or does not renew this any more.

    `holder` is random. `process` identifies the process on its computer. `renewed` counts; `until` is the date by the
    holder's own clock, for people: whether the lease still holds is seen by its changing.
    """

    holder: str
    what: str
    host: str
    process: str
    renewed: int = 0
    until: Annotated[str, AfterValidator(_date)]


class SharedBody(DeploymentBody):
    """What `LiveState` has, with the owner of the machines, their manifests by their names, and the lease."""

    repository: str
    owner: str
    manifests: dict[str, str] = Field(default_factory=dict)
    lease: Lease | None = None


class SharedState(Strict):
    """`kind: SharedState`: the live state of one application in a store that clones share."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["SharedState"] = "SharedState"
    metadata: EnvironmentMetadata
    spec: SharedBody


REPOSITORY = r"git\+(https|ssh)://[^\s:@/]+(@[^\s:@/]+)?(:\d+)?/\S+"


def _state(text: str) -> str:
    if text not in ("folder", "git") and not re.fullmatch(rf"{REPOSITORY}", text):
        raise ValueError("write folder, git, git+https://HOST/PATH or git+ssh://git@HOST/PATH without a password")
    return text


class ProjectBody(Strict):
    """Settings of all applications of a project."""

    state: Annotated[str, AfterValidator(_state)] = Field(
        default="folder",
        description="where the live state of deployments is: folder (.fogspec of this clone), git (refs of the remote "
        "origin, shared by all clones), or git+URL (refs of another repository)",
        examples=["git"],
    )


class Project(Strict):
    """`kind: Project`: `fogspec.yaml` beside `specs/`."""

    apiVersion: Literal["fogspec.dev/v1alpha1"]
    kind: Literal["Project"]
    spec: ProjectBody


def date_of(unix_s: float) -> str:
    """Return a date in UTC, to the second."""
    return datetime.fromtimestamp(unix_s, UTC).replace(microsecond=0).isoformat()
