"""The last check before a launch: the task asks for the job's machine, price, end and files, and for nothing else.

Commands compile tasks again before they launch them. This check does not rely on that: it compares a task with the job's own
machine and lifetime, so that no way to a launch leads past it.
"""

import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fogspec.backends.protocol import DEPLOYMENT_IDLE_MINUTES, TARGETS, Job, LaunchRefused
from fogspec.base import digest
from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.base.layout import MOST_BYTES
from fogspec.base.project_files import LinkedPath
from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import engine_settings

TASK = {
    "name",
    "resources",
    "api_server_access",
    "workdir",
    "secrets",
    "file_mounts",
    "setup",
    "run",
    "envs",
    "config",
}
UNPRICED = {"image_id", "labels", "ports"}  # of resources: they change neither the machine nor its price


def check_task(job: Job) -> None:
    """Raise LaunchRefused, with the first key that differs, unless the task is for this job."""
    if (wrong := next(_differences(job), None)) is not None:
        raise LaunchRefused("setup", f"its task is not what was approved, so nothing was started: {wrong}")


def check_sources(job: Job) -> None:
    """Raise LaunchRefused for a file or folder that would be sent to the machine and is not the project's, or was edited."""
    if (wrong := next(_foreign_sources(job), None)) is not None:
        raise LaunchRefused("setup", f"its task would send what is not the project's, so nothing was started: {wrong}")
    if (path := next(_edited_sources(job), None)) is not None:
        raise LaunchRefused("setup", f"{path} is not what was reviewed, so nothing was started")


def _differences(job: Job) -> Iterator[str]:
    if job.machine is None:
        yield "which machine it is for is not known"
        return
    resources, found = job.task.get("resources"), dict[str, Any]()
    if isinstance(resources, Mapping):
        found = {key: value for key, value in resources.items() if key not in UNPRICED}
    else:
        yield "resources is missing"
    end, cap = found.pop("autostop", None), found.pop("max_hourly_cost", None)
    wanted = _machine(job.machine)
    for key in [*wanted, *(key for key in found if key not in wanted)]:
        if found.get(key) != wanted.get(key):
            yield f"resources.{key} is {_shown(found.get(key))}, of its machine {_shown(wanted.get(key))}"
    yield from _cap(cap, job)
    yield from _end(end, job)
    limit = engine_settings(job.machine, job.lifetime_s)
    if job.task.get("config") != limit:
        yield f"config is {_shown(job.task.get('config'))}, of the job {_shown(limit)}"
    if job.task.get("api_server_access", False) is not False:
        yield f"api_server_access is {_shown(job.task['api_server_access'])}, of compiled tasks false"
    yield from (f"{key} is not a key of compiled tasks" for key in job.task if key not in TASK)


def _machine(machine: Machine) -> dict[str, Any]:
    """Return the resources that select the machine, as compiled tasks have them."""
    cloud = cloud_of(machine.infra)
    wanted: dict[str, Any] = {"infra": machine.infra} if cloud.on_skypilot else {}
    if cloud.instance_types:
        wanted["instance_type"] = machine.instance
    else:
        wanted |= {"cpus": f"{machine.cpus:g}", "memory": f"{machine.memory:g}"}
    if cloud.disk_gib is not None:
        wanted["disk_size"] = cloud.disk_gib
    if machine.gpu is not None:
        wanted["accelerators"] = machine.gpu.key
    if machine.spot and cloud.own_end is not OwnEnd.JOB_TIME_LIMIT:
        wanted["use_spot"] = True
    return wanted


def _cap(cap: object, job: Job) -> Iterator[str]:
    """Yield why the price cap is not the job's: its own, else the price of its machine, to the fourth decimal upwards."""
    price = (job.machine.price if job.machine else 0.0) if job.cap_usd_per_hour is None else job.cap_usd_per_hour
    most = math.ceil(round(price * 1e4, 6)) / 1e4
    if price <= 0 and cap is None:
        return
    if isinstance(cap, bool) or not isinstance(cap, (int, float)) or not 0 < cap <= most * (1 + 1e-9):
        yield f"resources.max_hourly_cost is {_shown(cap)}, of its machine ${most:g}"


def _end(end: object, job: Job) -> Iterator[str]:
    """Yield why the machine would not end by itself in time."""
    sample = job.lifetime_s is not None
    most = DEPLOYMENT_IDLE_MINUTES if job.lifetime_s is None else math.ceil(job.lifetime_s / 60)
    minutes = end.get("idle_minutes") if isinstance(end, Mapping) else None
    if isinstance(minutes, bool) or not isinstance(minutes, int) or not 0 < minutes <= most:
        yield f"resources.autostop.idle_minutes is {_shown(minutes)}, of the job at most {most}"
    elif isinstance(end, Mapping):
        wanted = {"idle_minutes": minutes, "down": True, **({"wait_for": "none"} if sample else {})}
        if end != wanted:
            key = next(key for key in [*wanted, *end] if end.get(key) != wanted.get(key))
            yield f"resources.autostop.{key} is {_shown(end.get(key))}, of the job {_shown(wanted.get(key))}"


def _foreign_sources(job: Job) -> Iterator[str]:
    yield from _foreign(job.root, job.task)
    if job.work is not None:
        workdir = {} if job.work.workdir is None else {"workdir": job.work.workdir}
        yield from _foreign(job.root, {"file_mounts": job.work.mounts, **workdir})


def _foreign(root: Path, task: Mapping[str, object]) -> Iterator[str]:
    mounts = task.get("file_mounts") or {}
    if not isinstance(mounts, Mapping):
        yield "file_mounts is not a map"
        return
    sources = {f"file_mounts.{target}": source for target, source in mounts.items()}
    if "workdir" in task:
        sources["workdir"] = task["workdir"]
    yield from (f"file_mounts.{target} is not a target of compiled tasks" for target in mounts if target not in TARGETS)
    for key, source in sources.items():
        parts = Path(source).parts if isinstance(source, str) else ()
        if not isinstance(source, str) or not source or os.path.isabs(source) or ".." in parts or "://" in source:
            yield f"{key} is {_shown(source)}, not a path inside the project"
        elif source.startswith("~"):
            yield f"{key} is {_shown(source)}, which is in a home directory"
        elif (link := _leaving(root, source, whole=key != "workdir")) is not None:
            yield f"{key}: {link} leads out of the project"


def _edited_sources(job: Job) -> Iterator[str]:
    for path, reviewed in ({} if job.work is None else job.work.digests).items():
        try:
            unchanged = digest.of_bytes(job.files.read(job.root / path, MOST_BYTES)) == reviewed
        except (OSError, LinkedPath):
            unchanged = False
        if not unchanged:
            yield path


def _leaving(root: Path, source: str, whole: bool) -> str | None:
    """Return the path that leads out of the root, links resolved: the source or, for a `whole` one, what is in it."""
    inside = os.path.realpath(root)
    found = [Path(root, source)]
    if whole and found[0].is_dir():
        found += [Path(folder, name) for folder, names, files in os.walk(found[0]) for name in (*names, *files)]
    return next((str(path) for path in found if not _is_below(os.path.realpath(path), inside)), None)


def _is_below(path: str, folder: str) -> bool:
    return os.path.commonpath([path, folder]) == folder


def _shown(value: object) -> str:
    return "missing" if value is None else repr(value)
