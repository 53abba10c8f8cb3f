"""A project on a Slurm cluster: its files, fogspec's command line with the cluster's SkyPilot, and what is left running."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from ruamel.yaml import YAML

from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from fogspec.results.io import read_results_folder
from fogspec.results.schema import LatencySummary, Measured, ResultsBody
from tests.support.results import write
from tests.tools.slurm import daemons, engine, login

SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{name: {name}}}
spec:
  cloud:
    - cmd: [python3, work.py]
  probe: {{callback: work}}
  constraints: {{latency: 2s, cost: $0.01/request}}
  objective: {{alpha: 0.5}}
  hardware: {{cpus: 1..128, memory: 1GiB..256GiB, memory_per_cpu: 1GiB..16GiB, gpus: [none]}}
  infra: [slurm/fogtest]
  benchmark:
    budget: $10
    machines: [{machines}]
    ready_timeout: 3min
    warmup: 1
    stop: {{requests: {steps}, duration: 1min}}
"""

# Latency follows the CPUs that the job was given: the node claims them, this machine need not have them.
WORK = """\
import os
import time

import fogspec_probe

cpus = int(os.environ["SLURM_JOB_CPUS_PER_NODE_PACK_GROUP_0"])
while True:
    fogspec_probe.start("work")
    time.sleep(0.02 + 0.4 / cpus)
    fogspec_probe.stop("work")
"""


@dataclass
class Bench:
    """A bench that runs, and what it said so far."""

    process: "subprocess.Popen[str]"
    events: list[dict[str, Any]] = field(default_factory=list)

    def until(self, wanted: Callable[[dict[str, Any]], bool], patience_s: float = 1200.0) -> dict[str, Any]:
        """The first event from now on that is wanted."""
        end = time.monotonic() + patience_s
        for event in self.lines():
            if wanted(event):
                return event
            assert time.monotonic() < end, self.events
        raise AssertionError(f"it ended: {self.events}")

    def lines(self) -> Iterator[dict[str, Any]]:
        """Its events as they come."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.events.append(json.loads(line))
            yield self.events[-1]

    def ended(self) -> int:
        """Its exit code."""
        for _ in self.lines():
            pass
        return self.process.wait()

    @property
    def at_once(self) -> int:
        """How many samples had started before the first of them ended."""
        seen = [event["event"] for event in self.events if event.get("event") in ("starts", "ends")]
        return seen.index("ends")

    def kill(self) -> None:
        """As a power cut would."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


@dataclass
class Site:
    """The cluster's folder and a project's."""

    cluster: Path
    project: Path
    patience_s: ClassVar[float] = 1200.0

    def write(self, name: str, machines: list[str], steps: int = 20, work: str = WORK) -> str:
        """A spec, whose path is returned, and its workload."""
        path = self.spec(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / "work.py").write_text(work)
        path.write_text(SPEC.format(name=name, machines=", ".join(machines), steps=steps))
        return str(path.relative_to(self.project))

    def spec(self, name: str) -> Path:
        """Where an application's spec is."""
        return self.project / "specs" / name / f"{name}.yaml"

    def run(
        self, *words: str, code: int | None = 0, patience_s: float | None = None, program: str = "fogspec"
    ) -> "subprocess.CompletedProcess[str]":
        """A command line, by default fogspec's."""
        ended = subprocess.run(self._argv(words, program), cwd=self.project, env=self._env(), capture_output=True, text=True,
                               timeout=patience_s or self.patience_s)  # fmt: skip
        assert code is None or ended.returncode == code, f"{words}: {ended.returncode}\n{ended.stdout}\n{ended.stderr}"
        return ended

    def compile(self, spec: str) -> None:
        """Compile with the cluster's prices, which the project has a copy of."""
        if self.at:
            shutil.copy(self.cluster / "catalog.csv", self.project / "prices.csv")
        self.run("compile", spec, *self.at)

    def bench(self, spec: str, *words: str, log: Path | None = None) -> Bench:
        """Start a bench on the cluster; its events go to `log` where one is given."""
        argv = self._argv(("bench", spec, "--runner", "skypilot", "--yes", "-o", "json", *words))
        with open(self.project / "bench.log", "ab") as said, open(log or os.devnull, "ab") as events:
            out = subprocess.PIPE if log is None else events
            return Bench(subprocess.Popen(argv, cwd=self.project, env=self._env(), stdout=out, stderr=said, text=True))

    def results(self, name: str) -> dict[str, Measured]:
        """The records by instance type."""
        body = read_results_folder(self.project / "results" / name).spec
        return {one.machine.instance: one for one in body.samples}

    def task(self, name: str, instance: str) -> dict[str, Any]:
        """A compiled task."""
        for path in (self.project / "compiled" / name / "tasks").iterdir():
            task = YAML(typ="safe").load(path)
            if re.sub("[^a-z0-9]+", "-", instance.lower()) in path.name:
                return dict(task)
        raise KeyError(instance)

    @property
    def at(self) -> tuple[str, ...]:
        """Where the prices are."""
        return ("--catalog", "prices.csv")

    def keys(self, name: str) -> None:
        """Make the key of the robot's end on the computer that applies."""
        script = self.project / "compiled" / name / "link" / "link.sh"
        subprocess.run(["bash", str(script), "robot", "keys"], check=True, capture_output=True, env=self._env())

    def links(self, name: str) -> Path:
        """Where an application's link has its public halves on the computer that applies."""
        return self.cluster / "sky" / ".fogspec" / "links" / name / "robot"

    def jobs(self, spare: str | None = None) -> list[str]:
        """Names of the machines that Slurm has jobs for, without those that begin with `spare`."""
        names = daemons.run(self.cluster, "squeue", "-h", "-o", "%j").split()
        # SkyPilot adds its user's hash to them.
        return _others([re.sub("-[0-9a-f]{8}$", "", name) for name in names], spare)

    def cancel(self, prefix: str) -> None:
        """End jobs behind SkyPilot's back, as a failing node does."""
        for line in daemons.run(self.cluster, "squeue", "-h", "-o", "%i %j").splitlines():
            number, name = line.split()
            if name.startswith(prefix):
                daemons.run(self.cluster, "scancel", number)

    def left(self, patience_s: float = 1200.0, spare: str | None = None) -> list[str]:
        """What still runs or is still known, when it has had time to end, without names that begin with `spare`."""
        end = time.monotonic() + patience_s
        while (found := self._running(spare)) and time.monotonic() < end:
            time.sleep(0.5)
        return found + _others(self._known(), spare)

    def _known(self) -> list[str]:
        """What SkyPilot has a record of."""
        return engine.clusters(self.cluster)

    def _running(self, spare: str | None) -> list[str]:
        """Jobs, and where there is none at all, processes of their user: its connections from outside stay a while."""
        jobs = self.jobs()
        return _others(jobs, spare) or ([] if jobs else login.processes())

    def _argv(self, words: tuple[str, ...], program: str = "fogspec") -> list[str]:
        return [sys.executable, "-m", program, *words]

    def _env(self) -> dict[str, str]:
        return engine.environment(self.cluster) | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def _others(names: list[str], spare: str | None) -> list[str]:
    return [name for name in names if spare is None or not name.startswith(spare)]


def recorded(site: Site, name: str) -> None:
    """Results as an earlier bench of `WORK` left them."""
    plan = read_document(site.project / "compiled" / name / "plan.yaml", Plan)
    records = [
        Measured(id=one.id, machine=one.machine, measured_on="a test", state="ok", requests=20, duration=60.0,
                 latency=LatencySummary(mean=0.02 + 0.4 / one.machine.cpus), spent=0.001)
        for one in plan.spec.samples
    ]  # fmt: skip
    body = ResultsBody(
        inputs=plan.spec.inputs, runner="skypilot", source="a test", samples=records,
    )  # fmt: skip
    write(site.project / "results" / name, body)
