"""Jobs on this host: the task's run script in a session of its own, limited to the machine's CPUs and memory.

Every process of a job has the job's name and directory in its environment, so any process can find and stop all of them; both
must match, so that a copy of a name in another checkout leads to no process. The task's
`setup` is not run: this host is used as its owner set it up.
"""

import contextlib
import math
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from fogspec.backends import agent_state
from fogspec.backends.local import limits, processes
from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Costs, DeploymentStatus, Job, LaunchRefused, SampleStatus, Unreachable
from fogspec.backends.task_check import check_sources
from fogspec.base import child
from fogspec.base.project_files import LinkedPath
from fogspec.catalog.machine import Machine
from fogspec.results.schema import Reason

MARK = "FOGSPEC_JOB"
WORK = "work"
GRACE_S = 10.0
# Variables of the user's shell that a workload need not, or must not, see: a number of threads set there would hide the
# job's CPUs. Names that a task lists are passed on.
CREDENTIALS = r"TOKEN|SECRET|PASSW|CREDENTIAL|API_?KEY|ACCESS_KEY|PRIVATE_KEY|^AWS_|^AZURE_|^GOOGLE_|^SSH_AUTH"
WITHHELD = re.compile(CREDENTIALS + r"|_NUM_THREADS$|^OMP_THREAD_LIMIT$")
# Mounts that the scripts find by a variable: the reviewed files, in place.
MOUNTED = (
    ("~/.fogspec/agent.pyz", "FOGSPEC_AGENT", ""),
    ("~/.fogspec/link", "FOGSPEC_LINK", ""),
    ("~/.fogspec/launch/cloud.launch.py", "FOGSPEC_LAUNCH", ".."),
)


class LocalBackend:
    """What samples and deployments have in common: one process tree per job."""

    name = "local"
    no_accelerators: ClassVar[str]

    def __init__(self) -> None:
        self._capacity = limits.host_capacity()

    def start(self, job: Job) -> None:
        """Start the run script; raise LaunchRefused if this host is too small or a secret is not in the environment."""
        self._launch(job)

    def stop(self, job: Job) -> None:
        """Send TERM, which the agent passes on, then KILL, to all processes with the job's name; remove their cgroups."""
        groups: set[str | None] = {_read(job, "group").decode()}
        groups |= {limits.cgroup_of(pid) for pid in processes.marked(MARK, mark_of(job))}
        if left := processes.end(MARK, mark_of(job), GRACE_S):
            raise Unreachable(f"processes {', '.join(map(str, left))} do not end")
        for group in filter(None, groups):
            with contextlib.suppress(OSError):
                os.rmdir(group)

    def list(self, owner: Owner, directory: Path) -> Sequence[str]:
        """Return the names of the owner's jobs that run here and have their directories below `directory`."""
        below, found, mark = os.path.realpath(directory) + os.sep, set[str](), f"{MARK}=".encode()
        for _, words in processes.environments():
            for word in (word for word in words if word.startswith(mark)):
                name, _, place = os.fsdecode(word.removeprefix(mark)).partition("@")
                if owner.has(name) and place.startswith(below):
                    found.add(name)
        return sorted(found)

    def _launch(self, job: Job) -> limits.LimitedProcess:
        machine = self._fitting(job.machine)
        check_sources(job)
        environment = self._environment(job)
        try:
            job.files.make_folder(job.directory / "out")
            script = job.directory / "run.sh"
            job.files.write(script, str(job.task.get("run") or "").encode())
            with job.files.append(job.directory / "run.log") as log:
                started = limits.start(
                    ["bash", str(script.absolute())],
                    cpus=max(1, math.ceil(machine.cpus)),
                    memory_gib=machine.memory,
                    cwd=self._workdir(job),
                    env=environment,
                    log=log,
                )
            if started.group is not None:
                job.files.write(job.directory / "group", str(started.group).encode())
        except OSError as problem:
            raise LaunchRefused("setup", f"cannot be started: {problem}") from problem
        return started

    def _workdir(self, job: Job) -> Path:
        """Return the directory that the job runs in."""
        return job.root / str(job.launched.get("workdir") or ".")

    def _fitting(self, machine: Machine | None) -> Machine:
        """Return the machine; raise LaunchRefused if this host cannot stand in for it."""
        cpus, memory_gib = self._capacity
        if machine is None:
            raise LaunchRefused("setup", "what shape it needs is not known")
        if machine.gpu is not None:
            raise LaunchRefused("capacity", f"{self.no_accelerators}: {machine.gpu.name} is not here")
        if machine.cpus > cpus or machine.memory > memory_gib:
            here = f"this host has {cpus} CPUs and {memory_gib:.1f} GiB"
            raise LaunchRefused("capacity", f"needs {machine.cpus:g} CPUs and {machine.memory:g} GiB; {here}")
        return machine

    def _environment(self, job: Job) -> dict[str, str]:
        secrets = _mapping(job.task.get("secrets"))
        if missing := [name for name in secrets if name not in os.environ]:
            raise LaunchRefused("setup", f"the environment does not have {', '.join(sorted(missing))}")
        shell = {k: v for k, v in child.environment().items() if k in secrets or not WITHHELD.search(k.upper())}
        task = {key: str(value) for key, value in _mapping(job.task.get("envs")).items()}
        environment = processes.equipped({**shell, **task}, job.directory / "out")
        mounts = _mapping(job.task.get("file_mounts"))
        for target, variable, below in MOUNTED:
            if target in mounts:
                environment[variable] = os.path.abspath(job.root / str(mounts[target]) / below)
        return {**environment, MARK: mark_of(job)}


class LocalSamples(LocalBackend):
    """Measures one sample at a time on this host."""

    at_once = 1
    poll_s = 0.2
    costs = Costs.NOTHING
    no_accelerators = "the local runner has no accelerators"

    def __init__(self) -> None:
        super().__init__()
        cpus, memory_gib = self._capacity
        self._own: dict[str, limits.LimitedProcess] = {}
        self.source = (
            f"measured on one host ({_processor()}, {cpus} CPUs, {memory_gib:.0f} GiB), each sample confined to its CPUs by "
            f"affinity and to its memory by {limits.memory_by()}: clock, turbo, caches and neighbours are that host's, "
            "not those of a machine of that shape"
        )

    def _workdir(self, job: Job) -> Path:
        """Return a copy of the snapshot: as on machines, no sample finds what another one wrote there."""
        place, copy = super()._workdir(job), job.directory / WORK
        if job.tree is None or "workdir" not in job.task:
            return place
        job.files.make_folder(copy)
        shutil.copytree(place, copy, symlinks=True, dirs_exist_ok=True)
        return copy

    def start(self, job: Job) -> None:
        """Start the run script, and keep its process for its exit code."""
        self._own[job.name] = self._launch(job)

    def poll(self, job: Job) -> SampleStatus:
        """Return the status by the job's files and processes; `lost` if it ended without an outcome."""
        own = self._own.get(job.name)
        alive = own.poll() is None if own is not None else bool(processes.found(MARK, mark_of(job)))
        out, machine = job.directory / "out", job.machine
        timings = out / "timings.jsonl"
        memory = "the memory" if machine is None else f"{machine.memory:g} GiB"
        measured_on = "local" if machine is None else f"local/{math.ceil(machine.cpus)}cpu-{machine.memory:g}gib"
        if alive:
            ready = timings.is_file() and timings.stat().st_size > 0
            return SampleStatus(running=True, timings=timings, ready=ready, measured_on=measured_on)
        outcome = agent_state.read_outcome(out / "outcome.json")
        if outcome is None and own is None:
            return SampleStatus(
                running=False, lost=True, measured_on=measured_on, detail="it ended with its controller"
            )
        if outcome is None:
            starved = own is not None and own.outcome() == "out_of_memory"
            early: Reason = "crash" if timings.exists() else "setup"
            reason = "out_of_memory" if starved else early
            outcome = agent_state.Outcome(reason=reason, detail=_ended_early(own, job))
        detail = outcome.detail
        if outcome.reason == "out_of_memory":
            detail = f"{memory} were not enough: {detail}"
        return SampleStatus(
            running=False,
            timings=timings,
            measured_on=measured_on,
            reason=outcome.reason,
            detail=detail,
            setup_s=outcome.setup_s,
            measured_s=outcome.measured_s,
            stopped_by=outcome.stopped_by,
            waited_s=outcome.waited_s,
            server=outcome.server,
        )

    def stop(self, job: Job) -> None:
        """Ask the agent to stop, which answers with an outcome; then stop whatever is left."""
        if (own := self._own.get(job.name)) is not None:
            own.end(grace_s=GRACE_S)
        super().stop(job)
        with contextlib.suppress(OSError):
            job.files.remove_tree(job.directory / WORK)


class LocalDeployments(LocalBackend):
    """Keeps deployments running on 127.0.0.1; they outlive the process that started them."""

    poll_s = 0.1
    no_accelerators = "this host has no accelerators known to fogspec"

    def poll(self, job: Job) -> DeploymentStatus:
        """Return the supervisor's report while the job has processes."""
        timings = b"".join(_read(job, f"out/{name}") for name in ("timings.1.jsonl", "timings.jsonl"))
        log = _read(job, "run.log")
        status = agent_state.deployment_status(_read(job, "out/state.json"), timings, "127.0.0.1")
        status = agent_state.with_last_line(status, log)
        if processes.found(MARK, mark_of(job)):
            return status
        ended = status.state == "ended"
        return DeploymentStatus(state="ended" if ended else "gone", detail=status.detail or _last_detail(log))


def mark_of(job: Job) -> str:
    """Return what every process of the job has in its environment: its name and directory."""
    return f"{job.name}@{os.path.realpath(job.directory)}"


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _read(job: Job, name: str) -> bytes:
    """Return the end of a file in the job's directory; nothing if it cannot be read, or if the workload made it a link."""
    try:
        with job.files.open(job.directory / name) as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - agent_state.TAIL_BYTES - 1))
            return file.read(agent_state.TAIL_BYTES + 1)
    except (OSError, LinkedPath):
        return b""


def _last_detail(log: bytes) -> str | None:
    """Return the supervisor's last detail, or else the last line of the nodes."""
    status = agent_state.status_in_log(log, None)
    return status.detail if status is not None and status.detail else agent_state.last_line(log)


def _ended_early(own: limits.LimitedProcess | None, job: Job) -> str:
    lines = _read(job, "run.log").decode("utf-8", "replace")[-4096:].splitlines()
    last = next(("".join(c for c in line if c.isprintable()) for line in reversed(lines) if line.strip()), "")
    code = own.poll() if own is not None else None
    return f"the run script ended with exit code {code}" + (f": {last.strip()[:300]}" if last else "")


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return os.uname().machine
