"""What a bench costs in time beside its samples: `python -m tests.bench_runner`.

Overhead of the local runner: wall time of a bench of samples, less that of a bench with nothing to do and the time from
each agent's start to its last request, per sample. Parallel samples: a recorded plan of nine machines replayed at the
pace at which it was recorded, against its longest sample. The agent's reader of resources: samples with it and without it
by turns, the CPU time of the agent itself and the latency of a node that computes for 5 ms.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fogspec.base.units import parse_duration_s
from fogspec.plan.schema import Plan
from fogspec.results.schema import LatencySummary, Measured, ResultsBody, with_checksum
from fogspec.spec import fingerprints
from fogspec.spec.loader import load, read_document
from tests.support.agent import AGENT
from tests.support.files import write_yaml
from tests.support.scenes import SPEC, Scene

SAMPLES = 6
LOCAL = SPEC.replace(
    "[local/1cpu-1gib, local/2cpu-1gib]", f"[{', '.join(f'local/1cpu-{n}gib' for n in range(1, SAMPLES + 1))}]"
)
LONGEST_S = 24.0
PAIRS, REQUESTS = 5, 1000
NODE = """\
import time
import fogspec_probe
while True:
    fogspec_probe.start("work")
    end_s = time.process_time() + 0.005
    while time.process_time() < end_s:
        pass
    fogspec_probe.stop("work")
"""
# The agent, whose own CPU time is printed; with a reader that reads nothing, if requested.
AGENT_RUN = """\
import resource, sys
agent, reads, *words = sys.argv[1:]
sys.path.insert(0, agent)
from fogspec_agent import resources, sample
if reads == "without":
    resources.Resources.begin = resources.Resources.look = lambda self: None
    sample.Resources = lambda: resources.Resources(resources.GpuReader([]))
sample.main(words)
used = resource.getrusage(resource.RUSAGE_SELF)
print(used.ru_utime + used.ru_stime)
"""
CLOUD = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: nine}
spec:
  cloud: [{cmd: [python3, work.py]}]
  probe: {callback: work}
  hardware: {cpus: 2..64, memory_per_cpu: 2GiB..8GiB, machines: {allow: [c6i.*, m6i.*, r6i.*]}}
  infra: [aws/us-east-1]
  benchmark: {sampler: grid, budget: $2, stop: {requests: 200, duration: 1min}, setup_timeout: 1min}
"""


def main() -> None:
    """Print one line a figure."""
    with tempfile.TemporaryDirectory() as scratch:
        print(overhead(Path(scratch, "local")))
        print(parallel(Path(scratch, "nine")))
        print(reader(Path(scratch, "reader")))


def overhead(folder: Path) -> str:
    """Seconds a sample, on this host."""
    scene = Scene.made(folder, spec=LOCAL)
    whole_s = _wall(scene.command("bench", "--runner", "local"), folder)
    empty_s = _wall(scene.command("bench", "--runner", "local"), folder)
    records = list(scene.records().values())
    assert len(records) == SAMPLES
    measured_s = sum(parse_duration_s(one[name]) for one in records for name in ("setup", "measuring"))
    each_s = (whole_s - empty_s - measured_s) / SAMPLES
    return (f"local runner: {each_s:.2f} s a sample beside set-up and measuring ({SAMPLES} samples; the bench itself "
            f"{empty_s:.2f} s)")  # fmt: skip


def reader(folder: Path) -> str:
    """What the reader of resources adds to the agent and to the node: ratios of medians."""
    folder.mkdir()
    (folder / "node.py").write_text(NODE)
    agent_cpus: dict[str, list[float]] = {"with": [], "without": []}
    latencies_s: dict[str, list[float]] = {"with": [], "without": []}
    own = []
    for pair in range(PAIRS):
        for reads in ("with", "without") if pair % 2 else ("without", "with"):
            out = folder / f"{pair}-{reads}"
            words = ["--out", str(out), "--steps", str(REQUESTS), "--after", "600", "--warmup", "1", "--startup", "60"]
            words += ["--process", json.dumps([sys.executable, str(folder / "node.py")])]
            ended = subprocess.run([sys.executable, "-c", AGENT_RUN, str(AGENT), reads, *words], cwd=folder, check=True,
                                   capture_output=True, text=True, env={**os.environ, "PYTHONPATH": ""})  # fmt: skip
            outcome = json.loads((out / "outcome.json").read_text())
            agent_cpus[reads].append(float(ended.stdout.split()[-1]) / outcome["duration_s"])
            records = [json.loads(line) for line in (out / "timings.jsonl").read_text().splitlines()]
            latencies_s[reads].append(statistics.quantiles([one["latency_s"] for one in records[1:]], n=10)[0])
            if reads == "with":
                own.append(outcome["resources"]["overhead"])
    cpu, latency = (
        {reads: statistics.median(one) for reads, one in found.items()} for found in (agent_cpus, latencies_s)
    )
    ratio = latency["with"] / latency["without"]
    return (
        f"reader of resources: {statistics.median(own):.5f} vCPUs by its own count; the agent takes {cpu['with']:.4f} vCPUs "
        f"with it, {cpu['without']:.4f} without it; 10th percentile of the latency, with it / without it: {ratio:.3f} "
        f"({PAIRS} pairs of {REQUESTS} requests)"
    )


def parallel(folder: Path) -> str:
    """Wall time of nine samples in parallel, as a multiple of the longest."""
    (folder / "specs").mkdir(parents=True)
    spec = folder / "specs/nine.yaml"
    spec.write_text(CLOUD)
    (folder / "specs/work.py").touch()
    fogspec = [sys.executable, "-m", "fogspec"]
    subprocess.run([*fogspec, "compile", "specs/nine.yaml"], cwd=folder, check=True, capture_output=True)
    plan = read_document(folder / "compiled/nine/plan.yaml", Plan)
    count = len(plan.spec.samples)
    records = [
        Measured(
            id=one.id, machine=one.machine, measured_on="a recording", state="ok", requests=200, spent=0.01,
            duration=LONGEST_S * (number + count) / (2 * count - 1), latency=LatencySummary(mean=0.1),
        )
        for number, one in enumerate(plan.spec.samples)
    ]  # fmt: skip
    body = ResultsBody(application=fingerprints.measured_digest(load([str(spec)])[0].application), runner="skypilot",
                       spent=0.09, samples=records)  # fmt: skip
    recorded = with_checksum(plan.metadata, body).model_dump(mode="json", exclude_none=True)
    write_yaml(folder / "recorded.yaml", recorded, "bench_runner")
    words = [*fogspec, "bench", "specs/nine.yaml", "--runner", "replay", "--from", "recorded.yaml", "--pace", "1"]
    wall_s = _wall(words, folder)
    return (f"{count} samples in parallel, replayed at the pace of the recording: {wall_s:.1f} s, the longest takes "
            f"{LONGEST_S:.1f} s: {wall_s / LONGEST_S - 1:+.1%}")  # fmt: skip


def _wall(argv: list[str], folder: Path) -> float:
    start = time.perf_counter()
    subprocess.run(argv, cwd=folder, check=True, capture_output=True, timeout=300)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
