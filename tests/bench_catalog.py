"""How long a compile over many offers takes, and how much memory: `python -m tests.bench_catalog`.

The offers are those of the development data (94,800 rows in SkyPilot's layout; more are made from them by copying
regions under other names). Whole processes are timed from outside: cold is without the cache of columns, warm with it.
"""

import csv
import gzip
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.conftest import SHARED

ROOT = Path(__file__).resolve().parent.parent
CLOUDS = ("aws", "azure", "gcp", "lambda", "vast")
COPIES = (1, 2, 4, 5.3)
RUNS = 7
SPEC = """apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: big}
spec:
  cloud: [{cmd: [node]}]
  probe: {callback: x}
  hardware: {cpus: 2..64, gpus: [none, T4]}
  infra: [aws, azure, gcp, lambda, vast]
  benchmark: {sampler: grid, stop: {duration: 1min}, budget: $100}
"""


def main() -> None:
    """Print one line for each number of offers."""
    source = SHARED / "data" / "catalog" / "skypilot-v8"
    if not source.is_dir():
        print("compile over a large catalog: needs the development data (FOGSPEC_SHARED)")
        return
    with tempfile.TemporaryDirectory() as scratch:
        here = Path(scratch)
        (here / "specs").mkdir()
        (here / "specs" / "big.yaml").write_text(SPEC)
        for copies in COPIES:
            folder, rows = (source, _count(source)) if copies == 1 else _enlarged(source, here / "catalog", copies)
            runs = RUNS if copies == 1 else 3
            cold, warm = _times(here, folder, runs, cold=True), _times(here, folder, runs, cold=False)
            for name, (walls, cpu, peak) in (("cold", cold), ("warm", warm)):
                middle, low, high = statistics.median(walls), min(walls), max(walls)
                print(
                    f"compile over {rows:,} offerings, {name}: median {middle:.3f} s (min {low:.3f}, max {high:.3f}, "
                    f"{runs} runs, whole process), CPU {min(cpu):.3f} s at least, peak {peak:.0f} MiB"
                )


def _times(here: Path, catalog: Path, runs: int, cold: bool) -> tuple[list[float], list[float], float]:
    cache = here / "cache"
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    argv = [sys.executable, "-m", "fogspec", "compile", "specs/big.yaml", "--catalog", str(catalog)]
    walls, cpu, peak = [], [], 0.0
    for run in range(runs + 1):
        if cold:
            shutil.rmtree(cache, ignore_errors=True)
        start = time.perf_counter()
        process = subprocess.Popen(argv, cwd=here, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        assert process.stderr is not None
        said = process.stderr.read()
        _, status, used = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(said.decode())
        if run:
            walls.append(time.perf_counter() - start)
            cpu.append(used.ru_utime + used.ru_stime)
            peak = max(peak, used.ru_maxrss / 1024)
    return walls, cpu, peak


def _count(folder: Path) -> int:
    return sum(text.count("\n") - 1 for cloud in CLOUDS for text in [_read(folder, cloud)])


def _read(folder: Path, cloud: str) -> str:
    return gzip.decompress((folder / cloud / "vms.csv.gz").read_bytes()).decode()


def _enlarged(source: Path, target: Path, copies: float) -> tuple[Path, int]:
    """A folder with so many times the offers."""
    shutil.rmtree(target, ignore_errors=True)
    total = 0
    for cloud in CLOUDS:
        head, *rows = csv.reader(_read(source, cloud).splitlines())
        region = head.index("Region")
        wanted = int(len(rows) * copies)
        (target / cloud).mkdir(parents=True)
        with gzip.open(target / cloud / "vms.csv.gz", "wt", compresslevel=1, newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(head)
            for number in range(wanted):
                row = list(rows[number % len(rows)])
                if number >= len(rows):
                    row[region] += f"-copy{number // len(rows)}"
                writer.writerow(row)
        total += wanted
    return target, total


if __name__ == "__main__":
    main()
