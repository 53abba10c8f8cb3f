"""Restates the paper's own measurements as results: `python -m tests.tools.restate_paper PAPER_FOLDER`.

PAPER_FOLDER holds `measured.csv`, the sampled runs that the authors published with their code (KeplerC/FogROS2-sky,
Apache-2.0, branch feature/gpu_mem_cpu_optimization, 2023-09), as one table. Figures are restated, nothing is added: a
latency is the authors' mean seconds a step, its spread was not published.
"""

import csv
import re
import sys
from pathlib import Path
from typing import Any

from fogspec.base.layout import Layout
from fogspec.catalog.machine import Gpu, Machine
from fogspec.language.fingerprints import measured_record
from fogspec.language.loader import load
from fogspec.results.schema import PUBLISHED, LatencySummary, Measured, ResultsBody
from tests.support.results import write

ROOT = Path(__file__).resolve().parents[2]
SPECS = ("grasp-planning-recorded", "vslam-recorded", "motion-planning-recorded")
APPLICATIONS = {
    "dexnet": "grasp-planning-recorded",
    "slam": "vslam-recorded",
    "mp_cubicles": "motion-planning-cubicles-recorded",
    "mp_apartment": "motion-planning-apartment-recorded",
}
SOURCE = (
    "measured by the authors of FogROS2-Config (Chen et al., ICRA 2024, arXiv 2311.05600) in September 2023 and published "
    "with their code (KeplerC/FogROS2-sky, Apache-2.0, branch feature/gpu_mem_cpu_optimization): mean seconds a step; "
    "AWS on-demand machines, us-east-1 prices; durations given as below one second are restated as one second"
)


def main(folder: Path) -> None:
    """Write the results of each of the paper's applications."""
    with open(folder / "measured.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    specs = [ROOT / "specs" / f"{name}.yaml" for name in SPECS]
    applications = {one.application.metadata.name: one for one in load(specs)}
    for app, name in APPLICATIONS.items():
        loaded = applications[name]
        body = restated(measured_record(loaded.application), [r for r in rows if r["app"] == app])
        layout = Layout.of(ROOT / "specs" / Path(loaded.path).name, name)
        made = "python -m tests.tools.restate_paper PAPER_FOLDER"
        write(layout.results, body, made)
        print(f"{layout.relative(layout.results)}: {len(body.samples)} samples")


def restated(inputs: dict[str, Any], rows: list[dict[str, str]]) -> ResultsBody:
    """The rows of one application as results."""
    samples = [_record(row) for row in sorted(rows, key=lambda r: (r["gpu"], float(r["vcpus"]), r["instance"]))]
    return ResultsBody(inputs=inputs, runner=PUBLISHED, source=SOURCE, samples=samples)


def _record(row: dict[str, str]) -> Measured:
    machine = Machine(
        infra="aws/us-east-1", instance=row["instance"], cpus=float(row["vcpus"]), memory=float(row["memory_gb"]),
        gpu=Gpu(name=row["gpu"], count=1) if row["gpu"] else None, price=float(row["usd_per_hour_us_east_1"]),
    )  # fmt: skip
    latency = LatencySummary(mean=float(row["sec_per_step"])) if row["sec_per_step"] else None
    return Measured(
        id=f"aws-us-east-1-{row['instance'].replace('.', '-')}", machine=machine, measured_on=f"aws/{row['instance']}",
        state="ok" if latency else "insufficient",
        detail=None if latency else "one step ended within the window: the authors report no latency",
        requests=int(row["steps"]), latency=latency, duration=_seconds(row["duration"]), spent=float(row["spent_usd"]),
    )  # fmt: skip


def _seconds(text: str) -> float:
    minutes, seconds = (re.search(rf"(\d+){unit}", text) for unit in "ms")
    return 60.0 * int(minutes[1] if minutes else 0) + int(seconds[1] if seconds else 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
