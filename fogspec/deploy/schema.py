"""The live state of an application: written before anything is started, so that no machine is ever lost."""

from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import AfterValidator

from fogspec.base.quantities import Duration, Id, Money, Strict
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import PlanMetadata


def _date(text: str) -> str:
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("a date says its time zone")
    return text


class DeployedMachine(Strict):
    """One machine that was started, or was about to be.

    `starting` until its nodes have answered once, then `serving`; `ending` when it is to go. `manifest` is the digest
    of the manifest that it was started for, `image` the one it runs where it has one, `fallback` counts how many
    machines before it in that manifest could not be had. `runs` is the digest of all that the machine is given, `files`
    the digests of the files and folders beside the spec among that.
    `at` is the reading, in seconds, of this host's clock since its `boot`; `since` is the date in UTC.
    """

    name: Id
    deployer: str
    state: Literal["starting", "serving", "ending"]
    manifest: str
    machine: Machine
    runs: str
    files: dict[str, str]
    fallback: int = 0
    image: str | None = None
    address: str | None = None
    at: Duration
    boot: str
    since: Annotated[str, AfterValidator(_date)]

    def up_s(self, now_s: float, boot: str, today: datetime) -> float:
        """Return the seconds since its start: by the monotonic clock, or over a restart of this host by the date."""
        if self.boot == boot:
            return max(0.0, now_s - self.at)
        return max(0.0, (today - datetime.fromisoformat(self.since)).total_seconds())


class DeploymentBody(Strict):
    """The machines, and the cost of those that are gone since the application was last down."""

    machines: list[DeployedMachine]
    spent: Money = 0.0


class LiveState(Strict):
    """`kind: LiveState`: `.fogspec/NAME/deployment.yaml`."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["LiveState"] = "LiveState"
    metadata: PlanMetadata
    spec: DeploymentBody


def date_of(unix_s: float) -> str:
    """Return a date in UTC, to the second."""
    return datetime.fromtimestamp(unix_s, UTC).replace(microsecond=0).isoformat()
