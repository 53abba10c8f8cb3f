"""What a bench costs in time beside its samples: `python -m tests.bench_runner`.

Overhead of the local runner: wall time of a bench of samples, less that of a bench with nothing to do and the time from
each agent's start to its last request, per sample. Parallel samples: a recorded plan of nine machines replayed at the
pace at which it was recorded, against its longest sample.
"""

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
from tests.support.files import write_yaml
from tests.support.scenes import SPEC, Scene

SAMPLES = 6
LOCAL = SPEC.replace(
    "[local/1cpu-1gib, local/2cpu-1gib]", f"[{', '.join(f'local/1cpu-{n}gib' for n in range(1, SAMPLES + 1))}]"
)
LONGEST_S = 24.0
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
