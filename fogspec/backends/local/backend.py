"""Jobs on this host: the work's script in a session of its own, limited to the machine's CPUs and memory.

Every process of a job has the job's name and directory in its environment, so any process can find and stop all of them; both
must match, so that a copy of a name in another checkout leads to no process. Nothing is set up: this host is used as its
owner set it up.
"""

import contextlib
import hashlib
import json
import math
import os
import shutil
import stat
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from fogspec.agent.processes import Process, adopt_orphans, offspring
from fogspec.agent.shared_memory import SharedMemory
from fogspec.backends import agent_state
from fogspec.backends.local import environment, limits, processes
from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Costs, DeploymentStatus, Job, LaunchRefused, SampleStatus, Unreachable, Work
from fogspec.backends.task_check import check_sources
from fogspec.base import child, host
from fogspec.base.layout import MOST_BYTES
from fogspec.base.project_files import LinkedPath
from fogspec.base.text import count
from fogspec.catalog.machine import Machine
from fogspec.results.schema import Reason

MARK = "FOGSPEC_JOB"
LABELS = "FOGSPEC_LABELS"
WORK = "work"
BUSY = 1.2  # processes that want to run, per CPU
GRACE_S = 10.0
BUILT = "FOGSPEC_BUILT"  # the spec's own folder: a colcon workspace in it is used as its owner built it
# Mounts that the scripts find by a variable: the reviewed files, in place.
MOUNTED = (
    ("~/.fogspec/agent.pyz", "FOGSPEC_AGENT", ""),
    ("~/.fogspec/link", "FOGSPEC_LINK", ""),
    ("~/.fogspec/launch/cloud.launch.py", "FOGSPEC_LAUNCH", ".."),
)


class LocalBackend:
    """What samples and deployments have in common: one process tree per job."""

    name = "local"
    apart = False
    no_accelerators: ClassVar[str]

    def __init__(self) -> None:
        self._capacity = host.capacity()

    def start(self, job: Job) -> None:
        """Start the run script; raise LaunchRefused if this host is too small or a secret is not in the environment."""
        self._launch(job)

    def stop(self, job: Job) -> None:
        """Send TERM, which the agent passes on, then kill all processes of the job until none is left."""
        self._end(job, lambda: processes.members(MARK, mark_of(job)))

    def _end(self, job: Job, find: processes.Find) -> None:
        groups = limits.groups(group_of(job))
        if left := processes.end(find, GRACE_S + limits.KILL_S, lambda: [*map(limits.end_group, groups)]):
            raise Unreachable(f"processes {', '.join(map(str, left))} do not end")

    def check_access(self, places: Collection[str], briefly: bool = False) -> None:
        """Do nothing: this host is here."""

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
        machine, work = self._fitting(job.machine), job.work
        if work is None:
            raise LookupError(f"{job.name} has nothing to run")
        check_sources(job)
        given = self._environment(job, work)
        try:
            job.files.make_folder(job.directory / "out")
            script = job.directory / "run.sh"  # a copy, which no later compile changes while it runs
            job.files.write(script, job.files.read(job.root / work.mounts[work.script], MOST_BYTES))
            with job.files.append(job.directory / "run.log") as log:
                started = limits.start(
                    ["bash", str(script.absolute()), *work.arguments],
                    cpus=max(1, math.ceil(machine.cpus)),
                    memory_gib=machine.memory,
                    cwd=self._workdir(job, work),
                    env=given,
                    log=log,
                    name=group_of(job),
                    grace_s=GRACE_S,
                    apart=self.apart,
                )
        except OSError as problem:
            raise LaunchRefused("setup", f"cannot be started: {problem}") from problem
        return started

    def _workdir(self, job: Job, work: Work) -> Path:
        """Return the directory that the job runs in."""
        if work.workdir is None:
            return job.root
        return job.root / work.workdir if job.tree is None else job.tree.absolute()

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

    def _environment(self, job: Job, work: Work) -> dict[str, str]:
        if missing := [name for name in work.secrets if name not in os.environ]:
            raise LaunchRefused("setup", f"the environment does not have {', '.join(sorted(missing))}")
        shell = environment.passed(child.environment(), work.secrets)
        set_at_launch = {key: value for key, value in work.envs.items() if value is not None}
        given = processes.equipped({**shell, **set_at_launch}, job.directory / "out")
        for target, variable, folder in MOUNTED:
            if target in work.mounts:
                given[variable] = os.path.abspath(job.root / work.mounts[target] / folder)
        if work.workdir is not None:
            given[BUILT] = os.path.abspath(job.root / work.workdir)
        if job.labels:
            given[LABELS] = json.dumps(dict(job.labels))
        return {**given, MARK: mark_of(job)}


class LocalSamples(LocalBackend):
    """Measures one sample at a time on this host."""

    at_once = 1
    apart = True  # while a deployment shares memory with the robot's nodes
    poll_s = 0.2
    costs = Costs.NOTHING
    no_accelerators = "the local runner has no accelerators"

    def __init__(self) -> None:
        super().__init__()
        cpus, memory_gib = self._capacity
        self._own: dict[str, _Started] = {}
        memory = limits.MEMORY_TEXT[limits.memory_by()]
        self.source = (
            f"measured on one host ({_processor()}, {cpus} CPUs, {memory_gib:.0f} GiB), each sample confined to its CPUs by "
            f"affinity and to its memory {memory}: clock, turbo, caches and neighbours are that host's, "
            "not those of a machine of that shape"
        )
        shell = child.environment()
        kept_back = len(shell) - len(environment.passed(shell))
        self.notes = (
            f"samples run on this host: CPUs by affinity, memory {memory}",
            f"withheld from the nodes: {count(kept_back, 'variable')} of your environment; to pass one on, name it in "
            "spec.secrets or give it a value in the node's env",
            *_busy(os.getloadavg()[0], os.cpu_count() or 1),
        )

    def _workdir(self, job: Job, work: Work) -> Path:
        """Return a copy of the snapshot: as on machines, no sample finds what another one wrote there."""
        place, copy = super()._workdir(job, work), job.directory / WORK
        if job.tree is None or work.workdir is None:
            return place
        job.files.make_folder(copy)
        shutil.copytree(place, copy, symlinks=True, dirs_exist_ok=True)
        return copy

    def start(self, job: Job) -> None:
        """Start the run script, keep its process for its exit code, and adopt what it leaves without a parent."""
        before, memory = frozenset(offspring()), SharedMemory()
        adopt_orphans()
        self._own[job.name] = _Started(self._launch(job), before, memory)

    def poll(self, job: Job) -> SampleStatus:
        """Return the status by the job's files and processes; `lost` if it ended without an outcome."""
        started = self._own.get(job.name)
        own = None if started is None else started.process
        alive = own.poll() is None if own is not None else bool(processes.found(MARK, mark_of(job)))
        out, machine = job.directory / "out", job.machine
        timings = out / "timings.jsonl"
        memory = "the memory" if machine is None else f"{machine.memory:g} GiB"
        measured_on = "local" if machine is None else f"local/{math.ceil(machine.cpus)}cpu-{machine.memory:g}gib"
        if alive:
            ready = _is_written(timings)
            return SampleStatus(running=True, timings=timings, ready=ready, measured_on=measured_on)
        outcome = agent_state.read_outcome(out / "outcome.json")
        if outcome is None and own is None:
            return SampleStatus(
                running=False, lost=True, measured_on=measured_on, detail="it ended with its controller"
            )
        if outcome is None:
            starved = own is not None and own.outcome() == "out_of_memory"
            early: Reason = "crash" if os.path.lexists(timings) else "setup"
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
            resources=outcome.resources,
        )

    def stop(self, job: Job) -> None:
        """Ask the agent to stop, which answers with an outcome; then stop whatever is left."""
        if (started := self._own.get(job.name)) is None:
            super().stop(job)
        else:
            self._end_own(job, started)
        with contextlib.suppress(OSError):
            job.files.remove_tree(job.directory / WORK)

    def _end_own(self, job: Job, started: "_Started") -> None:
        started.memory.look(lambda: self._members(job), again=True)
        started.process.end()
        self._end(job, lambda: self._members(job))
        processes.bury(self._orphans(job))
        started.memory.remove()
        if all(one.process.poll() is not None for one in self._own.values()):
            adopt_orphans(False)

    def _members(self, job: Job) -> set[int]:
        """Return the processes of a sample that this process started, also those that dropped its name."""
        first = self._own[job.name].process

        def also(known: dict[int, Process]) -> set[int]:
            found = self._orphans(job) & known.keys()
            if first.poll() is None:  # once it is reaped, another session may have its number
                found |= {pid for pid, one in known.items() if one.session == first.process.pid}
            return found

        return processes.members(MARK, mark_of(job), also)

    def _orphans(self, job: Job) -> set[int]:
        """Return the children that this process adopted since it started the sample."""
        firsts = {one.process.process.pid for one in self._own.values()}
        return processes.orphans(MARK, mark_of(job), self._own[job.name].before | firsts)


@dataclass(frozen=True, slots=True)
class _Started:
    """A sample that this process started; `before` are the children that this process had then."""

    process: limits.LimitedProcess
    before: frozenset[int]
    memory: SharedMemory


class LocalDeployments(LocalBackend):
    """Keeps deployments running on 127.0.0.1; they outlive the process that started them."""

    poll_s = 0.1
    no_accelerators = "this host has no accelerators known to fogspec"

    def close(self) -> None:
        """Nothing runs for it."""

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

    def labels(self, job: Job) -> Mapping[str, str]:
        """Return the labels in the environment of the job's processes; none if there is no process."""
        mark, labels = f"{MARK}={mark_of(job)}".encode(), f"{LABELS}=".encode()
        for _, words in processes.environments():
            found = [word.removeprefix(labels) for word in words if word.startswith(labels)]
            if mark in words and found:
                with contextlib.suppress(ValueError, RecursionError):
                    return {str(name): str(text) for name, text in _mapping(json.loads(found[0])).items()}
        return {}

    def read_log(self, job: Job) -> bytes:
        """Return the end of its log."""
        return _read(job, "run.log")


def mark_of(job: Job) -> str:
    """Return what every process of the job has in its environment: its name and directory."""
    return f"{job.name}@{os.path.realpath(job.directory)}"


def group_of(job: Job) -> str:
    """Return the name of the job's cgroup."""
    return limits.GROUP + hashlib.sha256(mark_of(job).encode()).hexdigest()[:32]


def _is_written(path: Path) -> bool:
    try:
        status = os.stat(path, follow_symlinks=False)
    except OSError:
        return False
    return stat.S_ISREG(status.st_mode) and status.st_size > 0


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


def _busy(load: float, cpus: int) -> list[str]:
    """Return the warning that other processes slow samples down, if they do."""
    return [f"warning: load {load:.1f} on {cpus} CPUs: these are figures of a busy host"] if load > BUSY * cpus else []


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return os.uname().machine
