"""Resources of tasks as `fogspec.compile.tasks` writes them, for jobs that tests make by hand."""

import math
from typing import Any

from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import engine_settings


def resources(machine: Machine, lifetime_s: float | None = None) -> dict[str, Any]:
    """The resources of a sample that lives so long, or of a deployment."""
    shape = {"instance_type": machine.instance}
    if machine.infra.startswith("slurm/"):
        shape = {"cpus": f"{machine.cpus:g}", "memory": f"{machine.memory:g}"}
    end = {"idle_minutes": 30, "down": True}
    if lifetime_s is not None:
        end = {"idle_minutes": math.ceil(lifetime_s / 60), "down": True, "wait_for": "none"}
    return {"infra": machine.infra, **shape, "max_hourly_cost": machine.price, "autostop": end, "labels": {}}


def config(machine: Machine, lifetime_s: float | None) -> dict[str, Any]:
    """The settings of a sample's task besides its resources, if it has any."""
    settings = engine_settings(machine, lifetime_s)
    return {} if settings is None else {"config": settings}
