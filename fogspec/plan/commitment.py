"""What a sample may cost at most: the times that its machine is paid for, each with a name, in one place.

    provisioning   from the request until the machine's own end is armed: boot, SkyPilot's runtime, copying files
    set-up         spec.benchmark.ready_timeout
    measuring      spec.benchmark.stop.duration
    collecting     fetching the results, and what SkyPilot rounds up to whole minutes
    teardown       from the end of all that until the cloud has no such machine

Set-up, measuring and collecting are the machine's lifetime, which its own end counts. A controller that can act
stops the machine before; the sum holds for one that cannot, from the moment at which the end is armed.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.base.units import shown_duration, shown_price
from fogspec.catalog.machine import Machine
from fogspec.language.schema import Benchmark

Usd = TypeVar("Usd", covariant=True)


class Billed(Protocol[Usd]):
    """A machine, or a catalog of them."""

    def usd(self, paid_s: float) -> Usd:
        """Return what it costs, or each of them, while it is there for so long."""


PROVISIONING_S = 300.0
COLLECTING_S = 300.0
TEARDOWN_S = 120.0
PATIENCE_S = 120.0  # a controller's, with a machine that is silent when its time is over


@dataclass(frozen=True, slots=True, kw_only=True)
class Commitment:
    """The times of one sample's machine in seconds, and what they cost."""

    measuring_s: float
    setup_s: float

    @classmethod
    def of(cls, benchmark: Benchmark) -> "Commitment":
        """Return the times of a spec's samples."""
        return cls(measuring_s=benchmark.stop.duration, setup_s=benchmark.ready_timeout)

    @property
    def wall_s(self) -> float:
        """The longest time that a sample takes once its machine is up."""
        return self.setup_s + self.measuring_s

    @property
    def lifetime_s(self) -> float:
        """How long the machine runs after its own end was armed, in whole minutes."""
        return math.ceil((self.wall_s + COLLECTING_S) / 60) * 60.0

    @property
    def machine_s(self) -> float:
        """The longest time from the request to the machine's own end."""
        return machine_s(self.lifetime_s)

    @property
    def deadline_s(self) -> float:
        """When the controller stops the sample, after the request; silence at that time is waited out."""
        return self.machine_s - PATIENCE_S

    @property
    def paid_s(self) -> float:
        """The longest time that is paid: all of it."""
        return self.machine_s + TEARDOWN_S

    def usd(self, machine: Billed[Usd]) -> Usd:
        """Return the most that a sample can cost on a machine, or on each of a catalog, disk and address included."""
        return machine.usd(self.paid_s)


def room_s(paid_s: float) -> float:
    """Return the longest time for set-up and measuring together with which a sample is paid for at most `paid_s`."""
    return (paid_s - PROVISIONING_S - TEARDOWN_S) // 60 * 60.0 - COLLECTING_S


def machine_s(lifetime_s: float) -> float:
    """Return the longest time from the request of a machine to its own end, which counts `lifetime_s`."""
    return PROVISIONING_S + lifetime_s


def power_off_s(task: Mapping[str, Any]) -> float | None:
    """Return how long after its first boot, or the begin of set-up, a task's machine is turned off.

    That is after autostop, which ends it for good.
    """
    resources = task.get("resources") or {}
    autostop = resources.get("autostop") or {}
    if not cloud_of(str(resources.get("infra", ""))).halts or autostop.get("wait_for") != "none":
        return None
    return machine_s(float(autostop["idle_minutes"]) * 60)


def engine_settings(machine: Machine, lifetime_s: float | None) -> dict[str, Any] | None:
    """Return SkyPilot's settings for the engine, a task's `config`; None if the engine needs none.

    With a lifetime the engine itself ends the machine, where it can. A pod is limited to the shape that was requested: what a
    node has to spare would be measured otherwise, and not be there when it serves.
    """
    cloud, settings = cloud_of(machine.infra), dict[str, Any]()
    if cloud.limits_pods:
        settings["set_pod_resource_limits"] = True
    if lifetime_s is not None:
        seconds = math.ceil(machine_s(lifetime_s))
        match cloud.own_end:
            case OwnEnd.JOB_TIME_LIMIT:
                settings["sbatch_options"] = {"time": math.ceil(seconds / 60)}
            case OwnEnd.POD_DEADLINE:
                settings["pod_config"] = {"spec": {"activeDeadlineSeconds": seconds}}
            case OwnEnd.AUTOSTOP | OwnEnd.POWER_OFF:
                pass
    return {cloud.name: settings} if settings else None


def unattended(machines: Iterable[Machine], each: Commitment, name: str) -> Iterator[str]:
    """Yield what becomes of machines that cost money if this computer goes off before SkyPilot has armed their end."""
    paid = [one for one in machines if one.price > 0 and cloud_of(one.infra).on_skypilot]
    for end in (OwnEnd.AUTOSTOP, OwnEnd.POWER_OFF):
        found = [one for one in paid if cloud_of(one.infra).own_end is end]
        if not found:
            continue
        clouds = ", ".join(sorted({cloud_of(one.infra).name for one in found}))
        dearest = shown_price(max(one.paid_usd_per_hour for one in found))
        if end is OwnEnd.AUTOSTOP:
            yield (
                f"if this computer goes off while a machine on {clouds} starts, it keeps running, at up to {dearest}, "
                f"until fogspec down {name}"
            )
        else:
            yield (
                f"if this computer goes off while a machine on {clouds} starts, it turns itself off "
                f"{shown_duration(each.machine_s)} after its boot; its disk is paid until fogspec down {name}"
            )
