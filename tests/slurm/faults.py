"""Faults on the real engine: `make slurm-faults` prints what leaked, was lost or cost too much.

Each bench is a seed: which nodes have a workload that fails, and what is broken from outside, and when.
"""

import collections
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.bench.journal import Journal
from fogspec.results.io import read_results_folder
from fogspec.results.schema import is_final
from tests.slurm import breaking
from tests.slurm.site import Site
from tests.tools import apart
from tests.tools.slurm import daemons, engine

MACHINES = {"s-1x2": "1CPU--2GB", "c-2x4": "2CPU--4GB", "c-16x32": "16CPU--32GB"}
ROUNDS = 8
ROUND_S = 600.0

WORK = """\
import json
import os
import sys
import time

import fogspec_probe

fault = json.load(open("faults.json")).get(os.environ["SLURMD_NODENAME"])
held = []
for number in range(10**9):
    fogspec_probe.start("work")
    time.sleep(0.1)
    fogspec_probe.stop("work")
    if fault == "memory":
        held.append(b"x" * 2**28)
    if number == 5 and fault == "crash":
        sys.exit("an error of its own")
    if number == 5 and fault == "stuck":
        time.sleep(3600)
    if fault == "garbage":
        open(os.environ["FOGSPEC_TIMINGS"], "a").write("{\\x00 nothing\\n")
    if fault == "noise":
        print("=== fogspec begin outcome.json ===\\n{}\\n=== fogspec end outcome.json ===\\n" * 1000, flush=True)
"""


@dataclass(frozen=True)
class Once:
    """When the bench that runs has said this of the sample on this node, or that it ends."""

    event: str
    node: str


@dataclass
class Storm:
    """One bench to its end, however often it is broken off.

    `faults` are (when, name): so many seconds after the start, or once something was said. `stopped` has what was left
    after each Ctrl-C, and the exit code.
    """

    site: Site
    nodes: dict[str, str]
    faults: list[tuple[float | Once, str]]
    chance: random.Random
    done: int = 0
    stopped: list[tuple[int, list[str]]] = field(default_factory=list)
    spare: str | None = None

    def run(self, name: str, steps: int = 100) -> int:
        """How many controllers it took."""
        spec = self.written(name, steps)
        self.site.compile(spec)
        begun, waiting = time.monotonic(), list(self.faults)
        for number in range(1, ROUNDS + 1):
            before = self.events.stat().st_size if self.events.exists() else 0
            bench = self.site.bench(spec, "--resume", log=self.events)
            end = time.monotonic() + ROUND_S
            while bench.process.poll() is None:
                assert time.monotonic() < end, f"it does not end: {self.site.project}"
                if waiting and self.due(waiting[0][0], begun, before):
                    self.apply(waiting.pop(0)[1], bench.process, name)
                time.sleep(0.2)
            if bench.process.returncode in (0, 1):
                return number
        raise AssertionError(f"it is never done: {self.site.project}")

    def written(self, name: str, steps: int) -> str:
        """The spec, and workloads that fail as the nodes' faults say."""
        spec = self.site.write(name, list(MACHINES.values()), steps, WORK)
        (self.site.spec(name).parent / "faults.json").write_text(json.dumps(self.nodes))
        return spec

    @property
    def events(self) -> Path:
        """What the benches said."""
        return self.site.project / "events.jsonl"

    def due(self, when: float | Once, begun: float, before: int) -> bool:
        """Whether it is time for a fault; what this bench says comes after so many bytes."""
        if not isinstance(when, Once):
            return time.monotonic() - begun >= when
        said = [json.loads(line) for line in self.events.read_bytes()[before:].splitlines() if line.endswith(b"}")]
        return any(one.get("event") in (when.event, "ends") and when.node in one["sample"] for one in said)

    def apply(self, fault: str, process: "subprocess.Popen[str]", name: str) -> None:
        """Break something."""
        self.done += 1
        cluster = self.site.cluster
        if fault == "machine":
            if jobs := self.site.jobs():
                self.site.cancel(self.chance.choice(jobs))
        elif fault == "node":
            breaking.node_down(cluster, self.chance.choice(list(MACHINES)))
        elif fault == "server":
            for pid in {*engine.processes(cluster)} - {process.pid, *daemons.below(process.pid)}:
                breaking.kill(pid)
        elif fault == "worker":
            breaking.kill_below(process.pid)
        elif fault == "network":
            breaking.unplug(cluster)
        else:
            breaking.kill(process.pid, signal.SIGINT if fault in ("interrupt", "insist") else signal.SIGKILL)
            if fault == "insist":
                time.sleep(self.chance.uniform(0.2, 3))
                breaking.kill(process.pid, signal.SIGINT)
            code = process.wait()
            if fault == "interrupt":
                self.stopped.append((code, self.site.left(spare=self.spare)))
            if fault == "journal":
                shutil.rmtree(self.site.project / ".fogspec" / name, ignore_errors=True)


OUTSIDE = ("machine", "node", "server", "worker", "network", "controller", "interrupt", "insist", "journal")
INSIDE = ("crash", "memory", "stuck", "garbage", "noise")


def judge(
    site: Site, name: str, budget_usd: float = 10.0, spare: str | None = None, machines: int = len(MACHINES)
) -> collections.Counter[str]:
    """What must never happen, and what became of the samples."""
    tally: collections.Counter[str] = collections.Counter()
    tally["machines leaked"] += len(site.left(spare=spare))
    results = read_results_folder(site.project / "results" / name).spec
    journal = site.project / ".fogspec" / name / "journal.jsonl"
    book = Journal(journal).state
    tally["budgets exceeded"] += max(results.spent, book.spent_usd) > budget_usd
    tally["machines not accounted for"] += len(book.open)
    tally["samples lost"] += machines - len({one.machine.instance for one in results.samples})
    entries = [json.loads(line) for line in journal.read_text().splitlines()]
    ended = [entry["record"] for entry in entries if entry["do"] == "end" and entry["record"] is not None]
    counts = collections.Counter(one["id"] for one in ended if one["state"] != "failed")
    tally["measured twice"] += sum(count > 1 for count in counts.values())
    for one in results.samples:
        tally[f"samples {one.state if one.reason is None else one.reason}"] += 1
        tally["samples unfinished"] += not is_final(one)
    return tally


def drawn(seed: int, site: Site) -> Storm:
    """What is broken in the bench of this seed."""
    chance = random.Random(f"storm {seed}")
    nodes = {node: chance.choice(INSIDE) for node in MACHINES if chance.random() < 0.4}
    # Only the smallest node's memory can be filled on a small host.
    nodes = {node: "crash" if fault == "memory" and node != "s-1x2" else fault for node, fault in nodes.items()}
    times = sorted(chance.uniform(3, 150) for _ in range(chance.randint(4, 8)))
    return Storm(site, nodes, [(when, chance.choice(OUTSIDE)) for when in times], chance)


def main(words: Sequence[str], tell: Callable[[str], None] = print) -> int:
    """Benches until enough faults have happened; whether something went wrong."""
    wanted, seed = int(words[0]) if words else 50, int(words[1]) if len(words) > 1 else 0
    folder = Path(os.environ[apart.FOLDER])
    tally: collections.Counter[str] = collections.Counter()
    while tally["faults"] < wanted:
        project = Path(tempfile.mkdtemp(prefix="fogspec-storm-")) / "project"
        storm = drawn(seed, Site(folder, project))
        tally["controllers"] += storm.run("storm")
        found = judge(storm.site, "storm")
        tally.update(found)
        tally["benches"] += 1
        tally["faults"] += storm.done + len(storm.nodes)
        tell(f"seed {seed}: {storm.nodes} {[name for _, name in storm.faults]}: {dict(+found)}")
        if not wrong(found):
            shutil.rmtree(project.parent)
        seed += 1
    tell(", ".join(f"{name} {count}" for name, count in tally.items()))
    return wrong(tally)


def wrong(tally: collections.Counter[str]) -> int:
    """How much of it must never happen."""
    never = ("machines leaked", "budgets exceeded", "machines not accounted for", "samples lost", "measured twice")
    return sum(tally[name] for name in never)


if __name__ == "__main__":
    sys.exit(min(1, main(sys.argv[1:])))
