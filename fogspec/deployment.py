"""What runs of an application: written before anything is started, so that nothing is ever lost sight of."""

import re
from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from fogspec.base import digest
from fogspec.base.fields import Duration, Money, Strict
from fogspec.plan import MachineRef, PlanMetadata

HOURS_PER_DAY = 24
LONGEST = 24


def _date(text: str) -> str:
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("a date says its time zone")
    return text


class Machine(Strict):
    """One machine that was started, or was about to be.

    `starting` until its nodes have answered once, then `serving`; `ending` when it is to go. `manifest` is the digest
    of the manifest that it was started for, `image` the one it runs where it has one, `fallback` counts how many
    machines before it in that manifest could not be had. `runs` is the digest of all that the machine is given, `files`
    the digests of the files and folders beside the spec among that.
    `at` is the reading, in seconds, of this host's clock since its `boot`; `since` is the date in UTC.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    deployer: str
    state: Literal["starting", "serving", "ending"]
    manifest: str
    machine: MachineRef
    runs: str
    files: dict[str, str]
    fallback: int = 0
    image: str | None = None
    address: str | None = None
    at: Duration
    boot: str
    since: Annotated[str, AfterValidator(_date)]

    def up_s(self, now_s: float, boot: str, today: datetime) -> float:
        """Seconds since it was started: by the clock that never jumps, or over a restart of this host by the date."""
        if self.boot == boot:
            return max(0.0, now_s - self.at)
        return max(0.0, (today - datetime.fromisoformat(self.since)).total_seconds())


class LiveBody(Strict):
    """The machines, and what those that are gone have cost since the application was last down."""

    machines: list[Machine]
    spent: Money = 0.0


class LiveState(Strict):
    """`kind: LiveState`: `.fogspec/NAME/deployment.yaml`."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["LiveState"] = "LiveState"
    metadata: PlanMetadata
    spec: LiveBody


def name_of(application: str, manifest: str, token: str) -> str:
    """The name of a launch: which application, which manifest (its digest), and a token that no other launch has."""
    return f"fogspec-{_short(application)}-{manifest.removeprefix('sha256:')[:8]}-{token}"


def is_launch_of(name: str, application: str) -> bool:
    """Whether a launch with this name is one of the application's, and not of one whose name begins alike."""
    return re.fullmatch(rf"fogspec-{re.escape(_short(application))}-[0-9a-f]{{8}}-[0-9a-f]{{6}}", name) is not None


def is_of(name: str, application: str) -> bool:
    """Whether a machine with this name was started for the application, to be measured or to be used."""
    return is_launch_of(name, application) or name.startswith(prefix_of(application))


def prefix_of(application: str) -> str:
    """What the names of all machines that an application's samples were ever measured on begin with."""
    return f"fogspec-{digest.of_bytes(application.encode())[7:15]}-"


def _short(application: str) -> str:
    """Names of clusters must be short on some clouds: a longer name ends in a digest of the whole."""
    if len(application) <= LONGEST:
        return application
    return f"{application[: LONGEST - 7].rstrip('-')}-{digest.of_value(application)[7:13]}"


def date_of(unix_s: float) -> str:
    """A date in UTC, to the second."""
    return datetime.fromtimestamp(unix_s, UTC).replace(microsecond=0).isoformat()
