"""Samples on this host: one process tree at a time, confined to the sample's CPUs and memory."""

import contextlib
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from fogspec.backends.local import limits, processes
from fogspec.backends.protocol import Job, LaunchRefused, Progress, Unreachable
from fogspec.backends.sample_outcome import read

MARK = "FOGSPEC_SAMPLE"
GRACE_S = 10.0
# What the user's shell knows and a workload need not, or must not: a number of threads set there would hide the
# sample's CPUs. Names a task asks for come back in.
CREDENTIALS = r"TOKEN|SECRET|PASSW|CREDENTIAL|API_?KEY|ACCESS_KEY|PRIVATE_KEY|^AWS_|^AZURE_|^GOOGLE_|^SSH_AUTH"
WITHHELD = re.compile(CREDENTIALS + r"|_NUM_THREADS$|^OMP_THREAD_LIMIT$")


class LocalRunner:
    """Runs the task's `run` script with bash; every process of a sample carries its name in its environment."""

    name = "local"
    at_once = 1
    poll_s = 0.2
    costs: Literal["nothing"] = "nothing"

    def __init__(self) -> None:
        cpus, memory_gib = limits.host_capacity()
        self._capacity = (cpus, memory_gib)
        self._own: dict[str, limits.LimitedProcess] = {}
        self.source = (
            f"measured on one host ({_processor()}, {cpus} CPUs, {memory_gib:.0f} GiB), each sample confined to its CPUs by "
            f"affinity and to its memory by {limits.memory_by()}: clock, turbo, caches and neighbours are that host's, "
            "not those of a machine of that shape"
        )

    def start(self, job: Job) -> None:
        """Start the job in a new folder; raises LaunchRefused when this host is too small for it."""
        machine, (cpus, memory_gib) = job.sample.machine, self._capacity
        if machine.gpu is not None:
            raise LaunchRefused("capacity", f"the local runner has no accelerators: {machine.gpu.name} is not here")
        if machine.cpus > cpus or machine.memory > memory_gib:
            here = f"this host has {cpus} CPUs and {memory_gib:.1f} GiB"
            raise LaunchRefused("capacity", f"needs {machine.cpus:g} CPUs and {machine.memory:g} GiB; {here}")
        environment = _environment(job)
        try:
            (job.folder / "out").mkdir(parents=True)
            script = job.folder / "run.sh"
            script.write_text(str(job.task.get("run") or ""), encoding="utf-8")
            log = job.folder / "run.log"
            self._own[job.name] = limits.start(
                ["bash", str(script.absolute())], cpus=max(1, math.ceil(machine.cpus)), memory_gib=machine.memory,
                cwd=job.root / str(job.task.get("workdir") or "."), env=environment, stdout_path=log, stderr_path=log,
            )  # fmt: skip
        except OSError as problem:
            raise LaunchRefused("setup", f"cannot be started: {problem}") from problem

    def look(self, job: Job) -> Progress:
        """What its folder and its processes say; `lost` when it ended without saying how."""
        own = self._own.get(job.name)
        alive = own.poll() is None if own is not None else bool(processes.found(MARK, job.name))
        out, machine = job.folder / "out", job.sample.machine
        timings = out / "timings.jsonl"
        measured_on = f"local/{math.ceil(machine.cpus)}cpu-{machine.memory:g}gib"
        if alive:
            ready = timings.is_file() and timings.stat().st_size > 0
            return Progress(running=True, timings=timings, ready=ready, measured_on=measured_on)
        outcome = read(out / "outcome.json")
        if outcome is None and own is None:
            return Progress(running=False, lost=True, measured_on=measured_on, detail="it ended with its controller")
        if outcome is None:
            starved = own is not None and own.outcome() == "out_of_memory"
            early = "crash" if timings.exists() else "setup"
            outcome = {"reason": "out_of_memory" if starved else early, "detail": _ended_early(own, job.folder)}
        if outcome["reason"] == "out_of_memory":
            outcome["detail"] = f"{machine.memory:g} GiB were not enough: {outcome['detail']}"
        said = outcome.get
        over_s, ready_s = said("duration_s"), said("setup_s")
        return Progress(
            running=False, timings=timings, measured_on=measured_on, reason=said("reason"), detail=said("detail"),
            setup_s=ready_s, measured_s=None if over_s is None or ready_s is None else max(0.0, over_s - ready_s),
            stopped_by=said("stopped_by"), waited_s=said("waited_s"),
        )  # fmt: skip

    def end(self, job: Job) -> None:
        """TERM, which the agent passes on and answers with an outcome; then KILL for all that bears the name."""
        own = self._own.get(job.name)
        if own is not None:
            own.end(grace_s=GRACE_S)
        if left := processes.end(MARK, job.name, GRACE_S):
            raise Unreachable(f"processes {', '.join(map(str, left))} do not end")

    def strays(self, prefix: str, folder: Path) -> list[str]:
        """Samples of this application that still run here, whoever started them."""
        return _strays(prefix, folder)


def _strays(prefix: str, folder: Path) -> list[str]:
    """Samples that begin with the prefix and write into a folder below this one."""
    mark, here, found = f"{MARK}={prefix}".encode(), os.fsencode(os.path.abspath(folder)) + b"/", set[bytes]()
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            words = Path("/proc", entry, "environ").read_bytes().split(b"\0")
            out = next((word.partition(b"=")[2] for word in words if word.startswith(b"FOGSPEC_OUT=")), b"")
            if os.path.abspath(out).startswith(here):
                found |= {word.partition(b"=")[2] for word in words if word.startswith(mark)}
    return sorted(os.fsdecode(name) for name in found)


def _environment(job: Job) -> dict[str, str]:
    secrets = _mapping(job.task.get("secrets"))
    if missing := [name for name in secrets if name not in os.environ]:
        raise LaunchRefused("setup", f"the environment does not have {', '.join(sorted(missing))}")
    kept = {k: v for k, v in os.environ.items() if k in secrets or not WITHHELD.search(k.upper())}
    given = {key: str(value) for key, value in _mapping(job.task.get("envs")).items()}
    return {**processes.equipped({**kept, **given}, job.folder / "out"), MARK: job.name}


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _marked(name: str) -> list[int]:
    """The living processes of a sample, whoever their parents are."""
    return processes.marked(MARK, name)


def _ended_early(own: limits.LimitedProcess | None, folder: Path) -> str:
    lines = (folder / "run.log").read_text(encoding="utf-8", errors="replace")[-4096:].splitlines()
    said = next(("".join(c for c in line if c.isprintable()) for line in reversed(lines) if line.strip()), "")
    code = own.poll() if own is not None else None
    return f"the run script ended with exit code {code}" + (f": {said.strip()[:300]}" if said else "")


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return os.uname().machine
