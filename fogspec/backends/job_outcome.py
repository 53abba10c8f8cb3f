"""What is kept of a job in its folder, and what its end there means: any process reads the same from it."""

import contextlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from fogspec.backends.protocol import Job, Progress
from fogspec.backends.sample_outcome import read
from fogspec.backends.skypilot import logs

LOG = "run.log"
ENDED = "ended.json"


def ended(job: Job, record: Mapping[str, Any], asked_s: float) -> Progress:
    """How a job ended, by what its log had and by SkyPilot's record of it; `asked_s` is when its machine was asked for."""
    log, out = job.folder / LOG, job.folder / "out"
    timings = out / "timings.jsonl"
    progress = Progress(running=False, timings=timings if timings.is_file() else None, measured_on=where(job))
    outcome = read(out / "outcome.json")
    if outcome is None:
        return replace(progress, **_unsaid(record.get("status"), log))
    if outcome["reason"] == "out_of_memory":
        outcome["detail"] = f"{job.sample.machine.memory:g} GiB were not enough: {outcome['detail']}"
    over_s, ran_s, first_s = record.get("end_at"), outcome["duration_s"], outcome["setup_s"]
    measured_s = None if ran_s is None or first_s is None else max(0.0, ran_s - first_s)
    whole_s = None if over_s is None or measured_s is None else over_s - asked_s
    return replace(
        progress, reason=outcome["reason"], detail=outcome["detail"], stopped_by=outcome["stopped_by"],
        waited_s=outcome["waited_s"], measured_s=measured_s,
        setup_s=None if whole_s is None or measured_s is None else max(0.0, whole_s - measured_s),
    )  # fmt: skip


def _unsaid(status: str | None, log: Path) -> dict[str, Any]:
    """What it means that the agent left no outcome."""
    words = logs.last_words(log)
    said = f"the job ended as {status}" + (f": {words}" if words else "")
    if status == "CANCELLED":
        return {"lost": True, "detail": said}
    if logs.out_of_memory(log):
        return {"reason": "out_of_memory", "detail": said}
    return {"reason": "setup" if status == "FAILED_SETUP" else "crash", "detail": said}


def where(job: Job) -> str:
    """The machine that it is measured on."""
    return f"{job.sample.machine.infra}/{job.sample.machine.instance}"


def kept(folder: Path) -> Progress | None:
    """The end that was written down, if it was."""
    said = load(folder / ENDED)
    if said is None:
        return None
    timings = folder / "out" / "timings.jsonl"
    return Progress(**{**said, "timings": timings if said.get("timings") else None})


def keep(folder: Path, progress: Progress) -> None:
    """Write down how it ended."""
    save(folder / ENDED, {**asdict(progress), "timings": progress.timings is not None, "recorded": None})


def load(path: Path) -> dict[str, Any] | None:
    """The values in a file; None where there are none."""
    with contextlib.suppress(OSError, ValueError):
        said = json.loads(path.read_text(encoding="utf-8"))
        return said if isinstance(said, dict) else None
    return None


def save(path: Path, data: Mapping[str, Any]) -> None:
    """Whole or not at all, and on disk before what it says can happen."""
    part = path.with_suffix(".part")
    with open(part, "w", encoding="utf-8") as file:
        json.dump(data, file)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
