"""SkyPilot as `fogspec.backends.skypilot.client` shows it, on this host: machines are folders, jobs are processes.

It keeps to what the real one was seen to do (tests/slurm runs the same suites against that one): launches take a while and
fail late, logs have a prefix before each line, a machine that is down takes its job and its files with it.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogspec.backends.local import processes
from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot.client import result
from fogspec.backends.skypilot.errors import CloudProblem, classify


@dataclass
class Machine:
    """A machine: up once its launch is through."""

    folder: Path
    up_s: float
    process: "subprocess.Popen[bytes] | None" = None
    ended_s: float | None = None
    labels: Mapping[str, str] = field(default_factory=dict)
    task: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Cloud:
    """What all clients see. `fails` is asked before each operation: a problem to raise instead, or None."""

    folder: Path
    launch_s: float = 0.2
    machines: dict[str, Machine] = field(default_factory=dict)
    refused: dict[str, CloudProblem] = field(default_factory=dict)
    without_access: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    closed: int = 0
    served: bool = True  # SkyPilot's API server runs before anything asks for it
    servers_ended: int = 0
    fails: Callable[[str, Mapping[str, Any]], Exception | None] = lambda _op, _words: None
    not_up: dict[str, str] = field(
        default_factory=dict
    )  # SkyPilot's status of machines that are rebooted, or turned off

    def denied(self, clouds: Sequence[str]) -> list[str]:
        return [one for one in clouds if one in self.without_access]

    def serves(self) -> bool:
        return self.served

    def end_server(self) -> None:
        self.servers_ended += 1

    def infras(self) -> list[str]:
        return list(self.known)

    def launch(self, task: Mapping[str, Any], name: str, root: str) -> dict[str, Any]:
        machine = self.machines[name] = Machine(self.folder / name, time.monotonic() + self.launch_s)
        shutil.copytree(
            Path(root) / str(task.get("workdir", ".")), machine.folder / "sky_workdir", ignore=_ours(self.folder)
        )
        for to, source in task.get("file_mounts", {}).items():
            there = machine.folder / to.removeprefix("~/")
            there.parent.mkdir(parents=True, exist_ok=True)
            copy = shutil.copytree if (Path(root) / source).is_dir() else shutil.copy
            copy(Path(root) / source, there)
        (machine.folder / "run.sh").write_text(str(task["run"]))
        machine.labels = task.get("resources", {}).get("labels", {})
        machine.task = task
        return {"request": name}

    def launched(self, request: str, name: str) -> dict[str, Any] | None:
        if request in self.refused:
            raise self.refused[request]
        machine = self._machine(request)
        if time.monotonic() < machine.up_s:
            return None
        if machine.process is None:
            home = machine.folder / "home"
            home.mkdir(exist_ok=True)
            environment = {"PATH": os.environ["PATH"], "HOME": str(machine.folder), "SKYPILOT_TASK_ID": request,
                           **machine.task.get("envs", {})}  # fmt: skip
            with open(machine.folder / "log", "wb") as log:
                machine.process = subprocess.Popen(
                    ["bash", str(machine.folder / "run.sh")], cwd=machine.folder / "sky_workdir", env=environment,
                    stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
                )  # fmt: skip
        return {"job": 1}

    def find(self, name: str) -> dict[str, Any] | None:
        return {"request": name} if name in self.machines or name in self.refused else None

    def jobs(self, name: str) -> list[dict[str, Any]]:
        process = self._machine(name).process
        if name in self.not_up:
            raise CloudProblem("setup", f"Cluster {name!r} is not up: {self.not_up[name]}", again=True)
        code = None if process is None else process.poll()
        status = "PENDING" if process is None else "RUNNING" if code is None else "FAILED" if code else "SUCCEEDED"
        return [{"job": 1, "status": status, "submitted_at": 0.0, "start_at": None, "end_at": time.time()}]

    def log(self, name: str, job: int, root: str, path: str, limit: int, follow: bool = False, tail: int = 0) -> int:
        machine = self._machine(name)
        lines = (machine.folder / "log").read_bytes().splitlines(keepends=True)[-tail:]
        said = b"".join(b"\x1b[36m(task, pid=1)\x1b[0m " + line for line in lines)[:limit]
        Path(path).write_bytes(said)
        return len(said)

    def clusters(self, prefix: str = "fogspec-", **_: Any) -> list[dict[str, Any]]:
        return [{"name": name, "status": self.not_up.get(name, "UP"), "ip": "192.0.2.1", "labels": dict(one.labels)}
                for name, one in self.machines.items() if name.startswith(prefix)]  # fmt: skip

    def waiting(self, prefix: str = "fogspec-") -> list[str]:
        return []

    def end(self, name: str) -> None:
        machine = self.machines.pop(name, None)
        if machine is not None:
            if machine.process is not None:
                _kill(machine.process, machine.folder)
            shutil.rmtree(machine.folder)

    def _machine(self, name: str) -> Machine:
        if name not in self.machines:
            raise CloudProblem("capacity", f"{name} does not exist", gone=True)
        return self.machines[name]


def _ours(folder: Path) -> Callable[[str, list[str]], list[str]]:
    return lambda where, names: [name for name in names if Path(where, name) == folder or name == "attempts"]


def _kill(process: "subprocess.Popen[bytes]", home: Path) -> None:
    """All that runs on the machine, as when it is switched off: whatever has its home there."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    while pids := processes.marked("HOME", str(home)):
        processes.send(pids, signal.SIGKILL)
        time.sleep(0.02)


def beside(local: Callable[[str], Any], cloud: Cloud) -> Callable[[str], Any]:
    """`registry.deployment_backend` with this cloud for every infra but this host."""
    from fogspec.backends.skypilot.backend import SkyPilotDeployments

    return lambda infra: local(infra) if infra == "local" else SkyPilotDeployments(SimulatedClient(cloud))


class Followed(Future[Any]):
    """A log that is followed to its end."""

    def __init__(self, client: "SimulatedClient", words: Mapping[str, Any]) -> None:
        super().__init__()
        self._client, self._words = client, words

    def done(self) -> bool:
        machine = self._client.cloud.machines.get(self._words["name"])
        running = machine is not None and machine.process is not None and machine.process.poll() is None
        self._client.run(Future() if running else self, "log", self._words)
        return not running


class SimulatedClient:
    """One process's view of the cloud."""

    version = "0.14.1"

    def __init__(self, cloud: Cloud) -> None:
        self.cloud = cloud

    def begin(self, op: str, **words: Any) -> Future[Any]:
        return Followed(self, words) if words.pop("follow", False) else self.run(Future(), op, words)

    def run(self, call: Future[Any], op: str, words: Mapping[str, Any]) -> Future[Any]:
        problem = self.cloud.fails(op, words)
        try:
            if problem is not None:
                raise problem
            call.set_result(getattr(self.cloud, op)(**words))
        except Unreachable as lost:
            call.set_exception(lost)
        except Exception as raised:
            call.set_exception(classify(raised))
        return call

    def call(self, op: str, timeout_s: float, **words: Any) -> Any:
        return result(self.begin(op, **words), timeout_s, op)

    def close(self) -> None:
        self.cloud.closed += 1
