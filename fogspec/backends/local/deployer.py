"""Deployments on this host: the task's run script in a session of its own, confined to the machine's shape.

It outlives whoever started it. Every process bears the launch's name in its environment, so that any process can find
and end all of them. The task's `setup` is not run: this host is as its owner set it up.
"""

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fogspec.backends import agent_state
from fogspec.backends.local import limits, processes
from fogspec.backends.local.runner import MARK as SAMPLE
from fogspec.backends.local.runner import WITHHELD
from fogspec.backends.protocol import DeploymentStatus, Launch, LaunchRefused, Unreachable

MARK = "FOGSPEC_DEPLOYMENT"
# Where scripts find what is mounted elsewhere: the reviewed files, in place.
MOUNTED = (
    ("~/.fogspec/agent", "FOGSPEC_AGENT", "agent.py"),
    ("~/.fogspec/link", "FOGSPEC_LINK", ""),
    ("~/.fogspec/launch/cloud.launch.py", "FOGSPEC_LAUNCH", ".."),
)
GRACE_S = 10.0


class LocalDeployer:
    """Keeps one process tree a launch, on 127.0.0.1."""

    name = "local"
    poll_s = 0.1

    def start(self, launch: Launch) -> None:
        """Start the run script; raises LaunchRefused when this host is too small, or a secret is not in the environment."""
        machine, (cpus, memory_gib) = launch.machine, limits.host_capacity()
        if machine is None:
            raise LaunchRefused("setup", "what shape it needs is not known")
        if machine.gpu is not None:
            raise LaunchRefused(
                "capacity", f"this host has no accelerators known to fogspec: {machine.gpu.name} is not here"
            )
        if machine.cpus > cpus or machine.memory > memory_gib:
            here = f"this host has {cpus} CPUs and {memory_gib:.1f} GiB"
            raise LaunchRefused("capacity", f"needs {machine.cpus:g} CPUs and {machine.memory:g} GiB; {here}")
        environment = _environment(launch)
        try:
            (launch.folder / "out").mkdir(parents=True, exist_ok=True)
            script = launch.folder / "run.sh"
            script.write_text(str(launch.task.get("run") or ""), encoding="utf-8")
            log = launch.folder / "run.log"
            started = limits.start(
                ["bash", str(script.absolute())], cpus=max(1, math.ceil(machine.cpus)), memory_gib=machine.memory,
                cwd=launch.root / str(launch.task.get("workdir") or "."), env=environment,
                stdout_path=log, stderr_path=log,
            )  # fmt: skip
            if started.group is not None:
                (launch.folder / "group").write_text(str(started.group), encoding="utf-8")
        except OSError as problem:
            raise LaunchRefused("setup", f"cannot be started: {problem}") from problem

    def look(self, launch: Launch) -> DeploymentStatus:
        """What its keeper says while it has processes."""
        out = launch.folder / "out"
        timings = b"".join(_read(out / name) for name in ("timings.1.jsonl", "timings.jsonl"))
        log = _read(launch.folder / "run.log")
        said = agent_state.with_words(
            agent_state.deployment_status(_read(out / "state.json"), timings, "127.0.0.1"), log
        )
        if processes.found(MARK, launch.name):
            return said
        return DeploymentStatus("ended" if said.state == "ended" else "gone", said.detail or _words(log))

    def end(self, launch: Launch) -> None:
        """TERM, which the keeper passes on; then KILL for all that bears the name, whether deployed or measured."""
        groups = {_group(pid) for pid in processes.found(MARK, launch.name)} | {_read(launch.folder / "group").decode()}
        for mark in (MARK, SAMPLE):
            if left := processes.end(mark, launch.name, GRACE_S):
                raise Unreachable(f"processes {', '.join(map(str, left))} do not end")
        for group in filter(None, groups):
            with contextlib.suppress(OSError):
                os.rmdir(group)

    def names(self, application: str, state: Path) -> Sequence[str]:
        """Launches and samples whose output is below the application's state folder."""
        below, found = os.path.realpath(state) + os.sep, dict[str, None]()
        for _, words in processes.environments():
            known = dict(word.split(b"=", 1) for word in words if b"=" in word)
            name = known.get(MARK.encode()) or known.get(SAMPLE.encode())
            out = os.fsdecode(known.get(b"FOGSPEC_OUT", b""))
            if name and os.path.realpath(out).startswith(below):
                found[os.fsdecode(name)] = None
        return list(found)


def _environment(launch: Launch) -> dict[str, str]:
    secrets = _mapping(launch.task.get("secrets"))
    if missing := [name for name in secrets if name not in os.environ]:
        raise LaunchRefused("setup", f"the environment does not have {', '.join(sorted(missing))}")
    kept = {k: v for k, v in os.environ.items() if k in secrets or not WITHHELD.search(k.upper())}
    given = {key: str(value) for key, value in _mapping(launch.task.get("envs")).items()}
    # The agent that was reviewed runs, not the one that is installed.
    mounts = _mapping(launch.task.get("file_mounts"))
    ours = {MARK: launch.name}
    for target, name, below in MOUNTED:
        if target in mounts:
            ours[name] = os.path.abspath(launch.root / str(mounts[target]) / below)
    return {**processes.equipped({**kept, **given}, launch.folder / "out"), **ours}


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _read(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            file.seek(max(0, path.stat().st_size - agent_state.TAIL_BYTES - 1))
            return file.read(agent_state.TAIL_BYTES + 1)
    except OSError:
        return b""


def _words(log: bytes) -> str | None:
    """What its keeper said last, or else the nodes."""
    said = agent_state.told(log, None)
    return said.detail if said is not None and said.detail else agent_state.last_words(log)


def _group(pid: int) -> str | None:
    """The cgroup of a process, where it is one of ours."""
    for line in _read(Path("/proc", str(pid), "cgroup")).decode().splitlines():
        path = line.partition("0::")[2].strip("/")
        if path.rpartition("/")[2].startswith("fogspec-"):
            return str(limits.CGROUPS / path)
    return None
