"""The end of a deployment by itself: when it is, and the task that makes the machine keep it.

The supervisor on the machine ends the nodes. After that the machine is ended by what the engine has for it: SkyPilot's
autostop, which runs on the machine, and besides it a job's time limit, a pod's deadline or a power-off timer. None needs
the computer that applied.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from fogspec.base import units
from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.base.errors import Refused
from fogspec.base.units import parse_until
from fogspec.catalog.machine import Machine
from fogspec.compile.manifest import Pinned
from fogspec.compile.tasks import ENDS, LEAST_LIFETIME_S, LIFETIME
from fogspec.deploy.schema import date_of
from fogspec.plan.commitment import PROVISIONING_S, TEARDOWN_S, engine_settings

KEPT_BY = {
    OwnEnd.AUTOSTOP: "autostop on the machine",
    OwnEnd.JOB_TIME_LIMIT: "autostop on the machine, and the job's time limit",
    OwnEnd.POD_DEADLINE: "autostop on the machine, and the pod's deadline",
    OwnEnd.POWER_OFF: "autostop on the machine, and a power-off timer of its first boot",
}


@dataclass(frozen=True, slots=True)
class End:
    """What ends a deployment: `until` as the spec has it, and the most that may be spent in USD."""

    until: str | None = None
    budget_usd: float | None = None

    @classmethod
    def of(cls, pinned: Pinned) -> "End":
        """Return the end in a manifest."""
        return cls(pinned.until, pinned.budget)

    def __bool__(self) -> bool:
        return self.until is not None or self.budget_usd is not None

    def date(self, machine: Machine, now: datetime, spent_usd: float) -> str:
        """Return when a machine that is started now ends, in UTC; `spent_usd` is spent already, or may be by others meanwhile.

        Raise Refused if that is in less than a minute.
        """
        found, reason = list[datetime](), "spec.deployment.until"
        if self.until is not None:
            until = parse_until(self.until)
            found.append(until if isinstance(until, datetime) else now + timedelta(seconds=until))
        if self.budget_usd is not None and machine.price > 0:
            cloud = cloud_of(machine.infra)
            paid_s = cloud.affordable_s(3600 * (self.budget_usd - spent_usd) / machine.paid_usd_per_hour)
            away_s = PROVISIONING_S + TEARDOWN_S if cloud.on_skypilot else 0.0
            found.append(now + timedelta(seconds=max(0.0, min(paid_s - away_s, 1e9))))
            reason = "spec.deployment.budget" if found[-1] == min(found) else reason
        end = min(found, default=now + timedelta(days=10_000))
        if (end - now).total_seconds() < LEAST_LIFETIME_S:
            spent = f"{units.dollars(spent_usd)} spent, or reserved for what still runs"
            raise Refused(
                f"{machine.instance} in {machine.infra}: {reason} is reached, or would be within a minute of its start",
                f"{spent}; fogspec down ends it and counts from zero"
                if reason.endswith("budget")
                else "set a later end in the spec, then: fogspec compile",
            )
        return date_of(end.timestamp())

    def text(self, infra: str) -> str:
        """Return when it ends and what keeps that, for people."""
        words = []
        if self.until is not None:
            words.append(
                f"{self.until} after apply" if isinstance(parse_until(self.until), float) else f"at {self.until}"
            )
        if self.budget_usd is not None:
            words.append(f"before {units.dollars(self.budget_usd)} are spent")
        cloud = cloud_of(infra)
        return f"{', and '.join(words)}, by {KEPT_BY[cloud.own_end] if cloud.on_skypilot else 'its supervisor'}"


NO_END = End()


def left_s(ends: str, now: datetime) -> float:
    """Return the seconds until a date."""
    return (datetime.fromisoformat(ends) - now).total_seconds()


def ended(ends: str | None, now: datetime) -> bool:
    """Return whether the date of an end has passed."""
    return ends is not None and left_s(ends, now) <= 0


def end_variables(ends: str, lifetime_s: float) -> dict[str, str]:
    """Return the variables of a machine that ends by itself after `lifetime_s`, at the date `ends` in UTC."""
    unix_s = datetime.fromisoformat(ends).astimezone(UTC).timestamp()
    return {LIFETIME: f"{lifetime_s:.0f}", ENDS: f"{unix_s:.0f}"}


def limited(task: Mapping[str, Any], machine: Machine, ends: str, lifetime_s: float) -> dict[str, Any]:
    """Return the task of a machine that ends by itself after `lifetime_s`, at the date `ends` in UTC."""
    envs = {**task.get("envs", {}), **end_variables(ends, lifetime_s)}
    autostop = {"idle_minutes": math.ceil(lifetime_s / 60), "down": True, "wait_for": "none"}
    config = engine_settings(machine, lifetime_s) if cloud_of(machine.infra).on_skypilot else None
    found = {**task, "envs": envs, "resources": {**task.get("resources", {}), "autostop": autostop}}
    return found if config is None else {**found, "config": config}
