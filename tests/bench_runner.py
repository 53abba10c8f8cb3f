"""What a bench costs in time beside its samples: `python -m tests.bench_runner`.

Overhead of the local runner: wall time of a bench of samples, less that of a bench with nothing to do and the time from
each agent's start to its last request, per sample. Parallel samples: a recorded plan of nine machines replayed at the
pace at which it was recorded, against its longest sample. The agent's reader of resources: samples with it and without it
by turns, the CPU time of the agent itself and the latency of a node that computes for 5 ms.
"""

import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from bisect import bisect_left as bisect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fogspec.base.units import parse_duration_s
from fogspec.language.fingerprints import measured_record
from fogspec.language.loader import load, read_document
from fogspec.language.lock_io import files_sent
from fogspec.plan.schema import Plan
from fogspec.results.schema import LatencySummary, Measured, ResultsBody
from tests.support.agent import AGENT
from tests.support.results import write
from tests.support.scenes import SPEC, Scene

SAMPLES = 6
LOCAL = SPEC.replace(
    "[local/1cpu-1gib, local/2cpu-1gib]", f"[{', '.join(f'local/1cpu-{n}gib' for n in range(1, SAMPLES + 1))}]"
)
LONGEST_S = 24.0
PAIRS, BLOCK_S, LOOKS = 60, 1.0, 5
# What is timed in each request, on one CPU with the agent.
NODES = {
    "computes for 5 ms": """\
    end_s = time.process_time() + 0.005
    while time.process_time() < end_s:
        pass
""",
    "wakes another process 50 times": """\
    for _ in range(50):
        os.write(there, b"?")
        os.read(back, 1)
""",
}
NODE = """\
import os, time
import fogspec_probe
(theirs, there), (back, ours) = os.pipe(), os.pipe()
if os.fork() == 0:
    os.close(there)
    while os.read(theirs, 1):
        os.write(ours, b"!")
    os._exit(0)
while True:
    fogspec_probe.start("work")
{work}    fogspec_probe.stop("work")
"""
# The agent, whose reader looks at each turn of its loop, several times, in one block of each pair and not at all in the other.
AGENT_RUN = """\
import json, os, random, sys, time
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
agent, out, block_s, looks, *words = sys.argv[1:]
sys.path.insert(0, agent)
from fogspec_agent import resources, sample
dice, blocks = random.Random(7), []
def look(self):
    now_s = time.monotonic()
    if self.first is None:
        return
    if not blocks or now_s - blocks[-1]["begun_s"] >= float(block_s):
        reads = dice.random() < 0.5 if len(blocks) % 2 == 0 else not blocks[-1]["reads"]
        blocks.append({"begun_s": now_s, "reads": reads, "looks": 0})
    if blocks[-1]["reads"]:
        for _ in range(int(looks)):
            self._look(now_s)
        blocks[-1]["looks"] += int(looks)
resources.Resources.look = look
sample.main(words)
json.dump(blocks, open(out, "w"))
"""
CLOUD = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: nine}
spec:
  cloud: [{cmd: [python3, work.py]}]
  probe: {callback: work}
  hardware: {cpus: 2..64, memory_per_cpu: 2GiB..8GiB, allow: [c6i.*, m6i.*, r6i.*]}
  infra: [aws/us-east-1]
  benchmark: {sampler: grid, budget: $5, stop: {requests: 200, duration: 1min}, ready_timeout: 1min}
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
    """What the reader of resources adds to a node's mean latency, at most, when it has the node's only CPU.

    Adjacent blocks of one sample are compared, one with the reader and one without, in random order: what changes slowly is in
    both. The reader looks many times as often as in a bench, once per `EVERY_S`, and the difference is divided by that.
    """
    folder.mkdir()
    found = []
    for work, lines in NODES.items():
        node, blocks_file, out = folder / "node.py", folder / "blocks.json", folder / "out"
        node.write_text(NODE.format(work=lines))
        words = [
            str(AGENT),
            str(blocks_file),
            str(BLOCK_S),
            str(LOOKS),
            "--out",
            str(out),
            "--warmup",
            "1",
            "--startup",
            "60",
        ]
        words += ["--after", str(2 * PAIRS * BLOCK_S + 2), "--process", json.dumps([sys.executable, str(node)])]
        subprocess.run([sys.executable, "-c", AGENT_RUN, *words], cwd=folder, check=True, capture_output=True,
                       env={**os.environ, "PYTHONPATH": ""})  # fmt: skip
        records = [json.loads(line) for line in (out / "timings.jsonl").read_text().splitlines()]
        used = json.loads((out / "outcome.json").read_text())["resources"]
        blocks = json.loads(blocks_file.read_text())
        each_s = used["overhead"] * used["window"] / sum(one["looks"] for one in blocks)
        pairs = list(_pairs(blocks, [one for one in records if "latency_s" in one]))
        share, low, high, times = effect(pairs)
        most = max(abs(low), abs(high)) / times
        found.append(
            f"a node that {work}: {100 * share:+.2f}% [{100 * low:+.2f}, {100 * high:+.2f}] with {times:.0f} looks per "
            f"second, each {each_s * 1e3:.2f} ms of CPU time; so less than {100 * most:.2f}% with one, at 95% confidence"
        )
        shutil.rmtree(out)
    return "\n".join(["reader of resources on the node's CPU, mean latency:", *found])


Pair = tuple[float, float, float]  # mean latency with the reader and without it, looks per second


def _pairs(blocks: list[dict[str, Any]], records: list[dict[str, Any]]) -> Iterator[Pair]:
    """Yield pairs of whole blocks, in which requests began and ended."""
    starts = [one["start_s"] for one in records]
    whole = []
    for block, following in itertools.pairwise(blocks):
        inside = records[bisect(starts, block["begun_s"]) : bisect(starts, following["begun_s"])]
        times_s = [one["latency_s"] for one in inside if one["start_s"] + one["latency_s"] < following["begun_s"]]
        whole.append((block, times_s, following["begun_s"] - block["begun_s"]))
    for pair in zip(whole[::2], whole[1::2], strict=False):
        (_, plain_s, _), (block, read_s, lasted_s) = sorted(pair, key=lambda one: one[0]["reads"])
        if plain_s and read_s:
            yield statistics.fmean(read_s), statistics.fmean(plain_s), block["looks"] / lasted_s


def effect(pairs: Sequence[Pair]) -> tuple[float, float, float, float]:
    """Return the relative difference of the means with its 95% interval, by drawing pairs again, and the looks per second."""
    with_s, without_s, times = np.array(pairs).T
    drawn = np.random.default_rng(7).integers(len(pairs), size=(4000, len(pairs)))
    ratios = with_s[drawn].sum(axis=1) / without_s[drawn].sum(axis=1) - 1
    low, high = np.quantile(ratios, (0.025, 0.975))
    return float(with_s.sum() / without_s.sum() - 1), float(low), float(high), float(times.mean())


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
    (one,) = load([str(spec)])
    inputs = measured_record(one.application, None, files_sent(one.application, one.layout))
    write(folder / "recorded", ResultsBody(inputs=inputs, runner="skypilot", samples=records))
    words = [sys.executable, "-m", "fogspec_lab", "replay", "specs/nine.yaml", "--from", "recorded", "--pace", "1"]
    wall_s = _wall(words, folder)
    return (f"{count} samples in parallel, replayed at the pace of the recording: {wall_s:.1f} s, the longest takes "
            f"{LONGEST_S:.1f} s: {wall_s / LONGEST_S - 1:+.1%}")  # fmt: skip


def _wall(argv: list[str], folder: Path) -> float:
    start = time.perf_counter()
    subprocess.run(argv, cwd=folder, check=True, capture_output=True, timeout=600)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
