"""The evaluation data in tests/data/suite/: 4 problems of the paper's samples, 32 made by rule on machines of the catalog.

Machines and prices are the bundled catalog's (AWS us-east-1, on demand). The paper's latencies are those restated in
`results/`. The others follow a rule of this module and were measured nowhere. `--check` compares and ends with 1 where a
file would differ.
"""

import csv
import io
import json
import random
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from math import exp, log2, sqrt
from pathlib import Path
from typing import Any

from fogspec.base.layout import Layout
from fogspec.catalog.sources import load_catalog
from fogspec.catalog.table import Catalog
from fogspec.results.io import read_results
from fogspec_lab.generated import write_or_check

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tests" / "data" / "suite"
GENERATIONS = ("5", "5a", "6a", "6g", "6i", "7a", "7g", "7i")
WITH_GPU = ("6i", "7a", "7g")  # generations that the machines with GPUs compete with
GIB_PER_S = {"T4": 298, "T4g": 298, "A10G": 559, "L4": 279, "L40S": 805}  # memory bandwidth, NVIDIA's data sheets
PAPER = {
    "grasp-planning": "gpu",
    "vslam": "family",
    "motion-planning-cubicles": "family",
    "motion-planning-apartment": "family",
}
COLUMNS = (
    "Cloud", "InstanceType", "AcceleratorName", "AcceleratorCount", "vCPUs", "MemoryGiB", "Price", "Region", "Family",
    "Arch", "PhysicalCores", "ClockGHz", "Burstable", "GpuMemMiB",
)  # fmt: skip

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Workload:
    """A program, by the constants of `latency_s`.

    `seconds` is its time on one core, `serial` the share that stays serial, `thread_gain` what a core's second thread
    adds, `contention` what each core costs the others (share of the whole), `memory_gib` what it likes to have, and
    `cores_per_t4` the number of cores that do what one T4 does, 0 if it uses no GPU.
    """

    name: str
    suite: str
    seconds: float
    serial: float
    thread_gain: float
    contention: float
    memory_gib: float
    cores_per_t4: float = 0.0


WORKLOADS = (
    Workload("plan-tree", "planning", 20.0, 0.20, 0.30, 0.0, 1.0),
    Workload("plan-graph", "planning", 45.0, 0.35, 0.10, 0.0, 12.0),
    Workload("map-dense", "mapping", 12.0, 0.02, 0.25, 0.0005, 6.0),
    Workload("map-sparse", "mapping", 3.0, 0.08, 0.15, 0.001, 3.0),
    Workload("pack-fast", "packing", 0.8, 0.04, 0.40, 0.0, 0.5),
    Workload("pack-small", "packing", 60.0, 0.01, 0.35, 0.0002, 24.0),
    Workload("solve-local", "solving", 6.0, 0.12, 0.05, 0.002, 2.0),
    Workload("solve-global", "solving", 150.0, 0.06, 0.0, 0.0003, 48.0),
    Workload("see-boxes", "seeing", 4.0, 0.03, 0.20, 0.0, 2.0, 24.0),
    Workload("see-grasps", "seeing", 30.0, 0.05, 0.20, 0.0, 4.0, 60.0),
    Workload("talk-short", "talking", 8.0, 0.01, 0.10, 0.0, 1.0, 12.0),
    Workload("talk-long", "talking", 90.0, 0.02, 0.10, 0.0, 8.0, 36.0),
)


def latency_s(workload: Workload, machine: Row) -> float:
    """Seconds a request: Amdahl's law over cores and their second threads, contention, scarce memory, chance.

    How fast a generation of processors is, in general, for a suite and for a workload, is drawn once; then each machine
    deviates by a few per cent, some by much more.
    """
    generation, cores = machine["Family"][1:], machine["PhysicalCores"]
    slowness = sum(
        sd * _normal(generation, *of)
        for sd, of in ((0.2, ()), (0.12, (workload.suite,)), (0.05, (workload.suite, workload.name)))
    )
    threads = cores * (1 + workload.thread_gain * (machine["vCPUs"] / cores - 1))
    parallel = threads
    if workload.cores_per_t4 and machine["AcceleratorName"]:
        bandwidth = GIB_PER_S[machine["AcceleratorName"]] / GIB_PER_S["T4"]
        parallel = workload.cores_per_t4 * bandwidth * machine["AcceleratorCount"] ** 0.8
    share = workload.serial + (1 - workload.serial) / parallel + workload.contention * threads
    short = max(0.0, log2(workload.memory_gib / machine["MemoryGiB"]))  # by so many halvings; a spec excludes worse
    spread = 0.02 * exp(0.8 * _normal("spread", workload.name, machine["InstanceType"]))
    chance = spread * _normal("machine", workload.name, machine["InstanceType"])
    return _rounded(workload.seconds * share * (1 + 0.25 * short) * exp(slowness + chance))


def files() -> dict[Path, str]:
    """The text of every file, by its path."""
    catalog = load_catalog(None, ["aws"])
    machines = [_machine(catalog, i) for i in range(len(catalog)) if _wanted(catalog, i)]
    measured = [(w.name, w.suite, m["InstanceType"], latency_s(w, m)) for w in WORKLOADS for m in machines]
    measured += [(name, name, *sample) for name in PAPER for sample in _published(name)]
    latencies = [
        {"workload": workload, "suite": suite, "cloud": "aws", "instance_type": instance, "latency_s": seconds}
        for workload, suite, instance, seconds in measured
    ]
    by_workload: dict[str, dict[str, float]] = {}
    for workload, _, instance, seconds in measured:
        by_workload.setdefault(workload, {})[instance] = seconds
    problems = [
        _problem(kind, group, workload, chosen, by_workload[workload])
        for kind, group, workload, chosen in _questions(machines, by_workload)
    ]
    return {
        FOLDER / "machines.csv": _csv(machines, COLUMNS),
        FOLDER / "latencies.csv": _csv(latencies, tuple(latencies[0])),
        FOLDER / "problems.jsonl": "".join(json.dumps(one) + "\n" for one in problems),
    }


def _wanted(catalog: Catalog, i: int) -> bool:
    family, gpu = str(catalog.family[i]), str(catalog.gpu[i])
    if catalog.region[i] != "us-east-1":
        return False
    if gpu:
        return gpu in GIB_PER_S
    return family[0] in "cmr" and family[1:] in GENERATIONS and 2 <= catalog.vcpus[i] <= 64


def _machine(catalog: Catalog, i: int) -> Row:
    gpu = str(catalog.gpu[i])
    memory = round(float(catalog.gpu_memory_gib[i]) * 1024) if gpu else ""
    return {
        "Cloud": "aws", "InstanceType": str(catalog.instance[i]), "AcceleratorName": gpu,
        "AcceleratorCount": int(catalog.gpu_count[i]) if gpu else "", "vCPUs": int(catalog.vcpus[i]),
        "MemoryGiB": _rounded(catalog.memory_gib[i]), "Price": _rounded(catalog.price_usd_per_hour[i]),
        "Region": "us-east-1", "Family": str(catalog.family[i]), "Arch": str(catalog.arch[i]),
        "PhysicalCores": int(catalog.physical_cores[i]), "ClockGHz": _rounded(catalog.clock_ghz[i]),
        "Burstable": int(catalog.burstable[i]), "GpuMemMiB": memory,
    }  # fmt: skip


def _published(name: str) -> Iterator[tuple[str, float]]:
    """What the paper's authors measured: instance types and seconds."""
    recorded = f"{name}-recorded"
    results = read_results(Layout.of(ROOT / "specs" / f"{recorded}.yaml", recorded))
    for sample in results.spec.samples:
        if sample.latency is not None:
            yield sample.machine.instance, _rounded(sample.latency.mean)


def _questions(machines: list[Row], latency: dict[str, dict[str, float]]) -> Iterator[tuple[str, str, str, list[Row]]]:
    """Kind, group and workload of every problem, and its machines."""
    for name, kind in PAPER.items():
        yield kind, "paper", name, [m for m in machines if m["InstanceType"] in latency[name]]
    plain = [m for m in machines if not m["AcceleratorName"]]
    on_cpus = [w.name for w in WORKLOADS if not w.cores_per_t4]
    for number, generation in enumerate(GENERATIONS):
        of_it = [m for m in plain if m["Family"][1:] == generation]
        for step in (0, 3, 6):  # each workload on three generations, each generation with three workloads
            yield "family", generation, on_cpus[(number + step) % len(on_cpus)], of_it
    for name in on_cpus[1::2]:
        yield "catalog", "all", name, plain
    beside = [m for m in machines if m["AcceleratorName"] or m["Family"][1:] in WITH_GPU]
    for workload in WORKLOADS:
        if workload.cores_per_t4:
            yield "gpu", "all", workload.name, beside


def _problem(kind: str, group: str, workload: str, machines: list[Row], latency: dict[str, float]) -> Row:
    """A problem with eight settings; limits are what half or a fifth of the machines meet, scales are the former."""
    seconds = [latency[m["InstanceType"]] for m in machines]
    usd = [m["Price"] / 3600 * s for m, s in zip(machines, seconds, strict=True)]
    (l20, l50), (c20, c50) = ((_met_by(values, 0.2), _met_by(values, 0.5)) for values in (seconds, usd))
    settings = (
        ("a0", 0.0, None, None), ("a.5", 0.5, None, None), ("a1", 1.0, None, None), ("a0_L50", 0.0, l50, None),
        ("a0_L20", 0.0, l20, None), ("a1_C50", 1.0, None, c50), ("a1_C20", 1.0, None, c20), ("a.5_L50C50", 0.5, l50, c50),
    )  # fmt: skip
    keys = ("name", "alpha", "max_latency_s", "max_cost_usd_per_request")
    return {
        "id": f"{kind}|{group}|{workload}", "kind": kind, "workload": workload,
        "machines": [f"aws/{m['InstanceType']}" for m in machines],
        "scale": {"latency_s": l50, "cost_usd_per_request": c50},
        "settings": [dict(zip(keys, one, strict=True)) for one in settings],
    }  # fmt: skip


def _met_by(values: list[float], share: float) -> float:
    """A limit that this share of the values meet, between two of them: one that is met exactly tests noise alone."""
    ordered = sorted(values)
    last = round(share * len(ordered)) - 1
    return _rounded(sqrt(ordered[last] * ordered[last + 1]))


def _normal(*key: str) -> float:
    """Standard normal, always the same for a key."""
    return random.Random("|".join(key)).gauss(0.0, 1.0)


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _csv(rows: list[Row], columns: tuple[str, ...]) -> str:
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


if __name__ == "__main__":
    sys.exit(write_or_check(files(), sys.argv[1:], "python -m tests.tools.public_suite"))
