"""Resources of tasks as `fogspec.compile.tasks` writes them, for jobs that tests make by hand."""

import math
import secrets
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogspec.backends.protocol import Job, Work
from fogspec.base.clouds import cloud_of
from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import engine_settings

GENERATED = {"source": "specs/app.yaml"}  # of scripts that tests render

# Work that no backend of the test runs.
WORK = Work(script="~/.fogspec/measure.sh", mounts={})


def resources(machine: Machine, lifetime_s: float | None = None) -> dict[str, Any]:
    """The resources of a sample that lives so long, or of a deployment."""
    shape: dict[str, Any] = {"instance_type": machine.instance}
    if machine.infra.startswith("slurm/"):
        shape = {"cpus": f"{machine.cpus:g}", "memory": f"{machine.memory:g}"}
    if (disk_gib := cloud_of(machine.infra).disk_gib) is not None:
        shape["disk_size"] = disk_gib
    end = {"idle_minutes": 30, "down": True}
    if lifetime_s is not None:
        end = {"idle_minutes": math.ceil(lifetime_s / 60), "down": True, "wait_for": "none"}
    return {"infra": machine.infra, **shape, "max_hourly_cost": machine.price, "autostop": end, "labels": {}}


def config(machine: Machine, lifetime_s: float | None) -> dict[str, Any]:
    """The settings of a sample's task besides its resources, if it has any."""
    settings = engine_settings(machine, lifetime_s)
    return {} if settings is None else {"config": settings}


def job_of(root: Path, task: Mapping[str, Any], **words: Any) -> Job:
    """A job of a task that is made by hand; the script of its work is what the task runs, in a file below the root."""
    script = Path("scripts") / f"{secrets.token_hex(4)}.sh"
    (root / script).parent.mkdir(exist_ok=True)
    (root / script).write_text(str(task.get("run", "")))
    work = Work(
        script="~/.fogspec/measure.sh",
        mounts={**task.get("file_mounts", {}), "~/.fogspec/measure.sh": script.as_posix()},
        workdir=task.get("workdir"),
        secrets=tuple(task.get("secrets", ())),
        envs={key: value if value is None else str(value) for key, value in task.get("envs", {}).items()},
    )
    return Job(root=root, work=work, task=task, **words)


def changed(job: Job, **task: Any) -> Job:
    """The job with other values in its task, and in its work."""
    return replace(job, work=job_of(job.root, {**job.task, **task}, name=job.name, owner=job.owner,
                                    directory=job.directory).work, task={**job.task, **task})  # fmt: skip
