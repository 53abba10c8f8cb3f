"""The files of a sample's job, and the outcome that they and SkyPilot's record of the job add up to, for any process."""

import contextlib
import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from fogspec.backends.agent_state import read_outcome, resource_use, server_facts
from fogspec.backends.protocol import Job, SampleStatus
from fogspec.backends.skypilot import logs
from fogspec.base.layout import MOST_BYTES
from fogspec.base.units import shown_memory

LOG = "run.log"
ENDED = "ended.json"


def final_status(job: Job, record: Mapping[str, Any], launched_s: float) -> SampleStatus:
    """Return the status of a job that ended, by its log and SkyPilot's record of it.

    `launched_s` is the time of its launch, in seconds since the epoch.
    """
    out = job.directory / "out"
    timings = out / "timings.jsonl"
    status = SampleStatus(
        running=False, timings=timings if job.files.is_file(timings) else None, measured_on=job.machine_name
    )
    outcome = read_outcome(out / "outcome.json")
    if outcome is None:
        return _without_outcome(status, record.get("status"), job)
    detail = outcome.detail
    if outcome.reason == "out_of_memory" and job.machine is not None:
        before = None if outcome.resources is None else outcome.resources.memory_before
        used = "" if before is None else f", of which {shown_memory(before)} were used before the nodes started,"
        detail = f"{job.machine.memory:g} GiB{used} were not enough: {detail}"
    ended_s, measured_s = record.get("end_at"), outcome.measured_s
    setup_s = None
    if ended_s is not None and measured_s is not None:
        setup_s = max(0.0, ended_s - launched_s - measured_s)
    return replace(
        status,
        reason=outcome.reason,
        detail=detail,
        stopped_by=outcome.stopped_by,
        waited_s=outcome.waited_s,
        measured_s=measured_s,
        setup_s=setup_s,
        server=outcome.server,
        resources=outcome.resources,
    )


def _without_outcome(status: SampleStatus, job_status: str | None, job: Job) -> SampleStatus:
    """Return the status of a job whose agent left no outcome."""
    log = job.directory / LOG
    line = logs.last_line(job.files, log)
    detail = f"the job ended as {job_status}" + (f": {line}" if line else "")
    if job_status == "CANCELLED":
        return replace(status, lost=True, detail=detail)
    starved = logs.out_of_memory(job.files, log)
    if not logs.measures(job.files, log):
        # A workspace that does not build with so much memory may serve with it, built elsewhere.
        return replace(status, reason="setup", detail=f"its set-up ran out of memory: {detail}" if starved else detail)
    return replace(status, reason="out_of_memory" if starved else "crash", detail=detail)


def read_final(job: Job) -> SampleStatus | None:
    """Return the final status that was written, if any."""
    values = load(job, ENDED)
    if values is None:
        return None
    timings = job.directory / "out" / "timings.jsonl"
    server = server_facts(values.get("server"))
    found = {
        "timings": timings if values.get("timings") else None,
        "server": server,
        "resources": resource_use(values.get("resources")),
    }
    return SampleStatus(**{**values, **found})


def write_final(job: Job, status: SampleStatus) -> None:
    """Write the final status."""
    server = None if status.server is None else status.server.model_dump(mode="json")
    others = {
        "timings": status.timings is not None,
        "recorded": None,
        "server": server,
        "resources": None if status.resources is None else status.resources.model_dump(mode="json"),
    }
    save(job, ENDED, {**asdict(status), **others})


def load(job: Job, name: str) -> dict[str, Any] | None:
    """Return the values in a file of the job's directory; None if it has none."""
    with contextlib.suppress(OSError, ValueError):
        values = json.loads(job.files.read(job.directory / name, MOST_BYTES))
        return values if isinstance(values, dict) else None
    return None


def save(job: Job, name: str, data: Mapping[str, Any]) -> None:
    """Write a file in the job's directory, whole or not at all, and sync it."""
    job.files.write(job.directory / name, json.dumps(data).encode())
