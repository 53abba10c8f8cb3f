"""An adaptive campaign, killed at every write: the real bench on a replayed sweep, with machines that are not to be had.

Each run is killed once, goes on as another process would, and must end with the very results of a run that nobody killed.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from fogspec.bench import run as benching
from fogspec.bench.journal import Journal
from fogspec.bench.prepare import prepare
from fogspec.bench.progress import Lines
from fogspec.catalog.table import Catalog
from fogspec.compile.compiler import compile_application
from fogspec.compile.inputs import Inputs
from fogspec.language.loader import LoadedSpec
from fogspec_lab.recordings import replayable
from fogspec_lab.replay import ReplaySamples

SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: demo}
spec:
  cloud: [{cmd: [python3, work.py]}]
  probe: {callback: plan}
  constraints: {latency: 5s}
  objective: {alpha: 1}
  hardware: {cpus: 2..64}
  infra: [aws/r1, aws/r2]
  benchmark: {sampler: adaptive, budget: $6, stop: {requests: 20, duration: 1min}, ready_timeout: 1min, batch_size: 2}
"""
HEAD = "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,Price,SpotPrice,Region,AvailabilityZone\n"
GONE = ("a.2", "b.8")


class Killed(BaseException):
    """kill -9."""


class FastClock:
    """Waiting takes no time."""

    def __init__(self) -> None:
        self.now = 0.0

    def now_s(self) -> float:
        return self.now

    def boot(self) -> str:
        return "a boot"

    def unix_s(self) -> float:
        return 1.7e9 + self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def project(folder: Path) -> None:
    """Spec, catalog, sweep; two machines are in no region to be had, two in the other region only."""
    machines = [(f"{name}.{cpus}", cpus, cpus * per, price * cpus) for name, per, price in (("a", 2, 0.02), ("b", 4, 0.025))
                for cpus in (2, 4, 8, 16, 32, 64)]  # fmt: skip
    rows = [f"{name},,,{cpus},{gib},{price * more:.4f},,{region},\n" for name, cpus, gib, price in machines
            for region, more in (("r1", 1.0), ("r2", 1.1))]  # fmt: skip
    sweep = [f"{name},{'aws/r2' if name in ('a.4', 'b.16') else ''},{6 * (0.1 + 0.9 / cpus) + 0.01 * cpus:.5f}\n"
             for name, cpus, _, _ in machines if name not in GONE]  # fmt: skip
    (folder / "specs").mkdir(parents=True)
    (folder / "specs/demo.yaml").write_text(SPEC)
    (folder / "offers.csv").write_text(HEAD + "".join(rows))
    (folder / "sweep.csv").write_text("instance_type,infra,latency_s\n" + "".join(sweep))
    compile_application(inputs_of(folder)).write()


def inputs_of(folder: Path) -> Inputs:
    """The project's inputs."""
    return Inputs.load([str(folder / "specs/demo.yaml")], catalog=str(folder / "offers.csv"))[0]


def opened(folder: Path) -> tuple[LoadedSpec, Catalog]:
    """The project's spec and catalog."""
    inputs = inputs_of(folder)
    return inputs.spec, inputs.catalog


def run(folder: Path) -> None:
    """One bench, as the command line makes it."""
    inputs, clock = inputs_of(folder), FastClock()
    found, source = replayable(str(folder / "sweep.csv"), 60.0)
    runner = ReplaySamples(found, source, clock.now_s)
    with mock.patch.object(benching, "SystemClock", return_value=clock):
        benching.bench(prepare(inputs, []), runner, lambda _: Lines(lambda _: None),
                       benching.BenchOptions(catalog=inputs.catalog))  # fmt: skip


@contextmanager
def killed_at(step: int) -> Iterator[list[int]]:
    """Raise Killed at the given one of all writes, and at every one after it: the dead write nothing."""
    count = [0]

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*words: Any, **more: Any) -> Any:
            count[0] += 1
            if count[0] >= step:
                raise Killed
            return real(*words, **more)

        return call

    replace, append = counted(os.replace), counted(Journal.append)
    with mock.patch("os.replace", replace), mock.patch.object(Journal, "append", append):
        yield count


def kept(folder: Path) -> dict[str, str]:
    """What a user has in the end, without what was paid: each machine of the killed costs its minute at least.

    Temporary files of a killed command do not count.
    """
    paths = [
        *folder.glob("results/demo/*.yaml"),
        folder / "compiled/demo/plan.yaml",
        *folder.glob("compiled/demo/tasks/*.yaml"),
    ]
    paid = re.compile(r"^(  spent|    spent|integrity): .*$", re.MULTILINE)
    return {str(path.relative_to(folder)): paid.sub("", path.read_text("utf-8")) for path in paths}


def main(every: int = 1) -> dict[str, int]:
    """Kill at every `every`-th write; counts of runs, batches, samples without a machine, and runs that ended differently."""
    with tempfile.TemporaryDirectory() as scratch:
        first = Path(scratch, "first")
        project(first)
        with killed_at(10**9) as count:
            run(first)
        writes, expected = count[0], kept(first)
        text = "".join(one for name, one in expected.items() if name.startswith("results/"))
        batches = set(re.findall(r"^    batch: \d+$", text, re.MULTILINE))
        tally = {"adaptive benches": 1, "writes": writes, "batches": len(batches),
                 "samples without a machine": text.count("reason: capacity"), "ended differently": 0}  # fmt: skip
        for step in range(1, writes + 1, every):
            folder = Path(scratch, str(step))
            project(folder)
            try:
                with killed_at(step):
                    run(folder)
            except Killed:
                run(folder)
            tally["adaptive benches"] += 1
            tally["ended differently"] += kept(folder) != expected
            shutil.rmtree(folder)
    return tally


if __name__ == "__main__":
    print(", ".join(f"{name} {value}" for name, value in main().items()))
