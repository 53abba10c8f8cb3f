"""How far a part of a machine is from the type that it stands for: `python -m tests.tools.nested_errors`.

Reads the development data (FOGSPEC_SHARED): throughput of a CPU-bound program with 1 to n workers on each instance type. On a
machine with two vCPUs per core half as many workers, one per core, are counted times what the second threads add. Pairs are of
one family, CPU model and memory per vCPU.
"""

import csv
import gzip
import math
from collections import defaultdict
from collections.abc import Iterator

from fogspec.numerics.nested import PARTS
from tests.conftest import SHARED

Workers = dict[int, float]  # throughput by number of workers
TITLES = {False: "one vCPU per core", True: "two vCPUs per core"}


def main() -> None:
    """Print a row for each kind of machine and part."""
    found = defaultdict(list)
    for shared, part, error in errors():
        found[shared, part].append(error)
        found[shared, 0].append(error)
    for shared, title in TITLES.items():
        for part in (0, *PARTS):
            some = sorted(found[shared, part])
            median, p90 = some[len(some) // 2], some[int(0.9 * len(some))]
            print(f"| {title} | {f'1/{part}' if part else 'all'} | {len(some)} | {median:.1%} | {p90:.1%} |")


def errors() -> Iterator[tuple[bool, int, float]]:
    """Yield whether cores are shared, the part, and the absolute error of the logarithm."""
    for sizes in _families():
        for vcpus, (workers, shared) in sizes.items():
            for part in PARTS:
                own = sizes.get(vcpus // part) if vcpus % part == 0 else None
                told = None if own is None else _told(workers, vcpus, part, shared)
                if own is not None and told is not None:
                    yield shared, part, abs(math.log(told / own[0][vcpus // part]))


def _told(workers: Workers, vcpus: int, part: int, shared: bool) -> float | None:
    """Return the throughput of a part of the machine; None if it was not measured."""
    if not shared:
        return workers.get(vcpus // part)
    if vcpus // part < 2 or vcpus // part // 2 not in workers or vcpus // 2 not in workers:
        return None
    return workers[vcpus // part // 2] * workers[vcpus] / workers[vcpus // 2]


def _families() -> list[dict[int, tuple[Workers, bool]]]:
    with open(SHARED / "data" / "priors" / "machines.csv", newline="") as file:
        about = {(row["Cloud"], row["InstanceType"]): row for row in csv.DictReader(file)}
    measured: dict[tuple[str, str], Workers] = defaultdict(dict)
    with gzip.open(SHARED / "data" / "servers" / "workers.csv.gz", "rt") as file:
        for row in csv.DictReader(file):
            measured[row["cloud"], row["instance_type"]][int(row["workers"])] = float(row["throughput"])
    families: dict[tuple[object, ...], dict[int, tuple[Workers, bool]]] = defaultdict(dict)
    for key, workers in measured.items():
        one = about.get(key)
        if one is None or one["AcceleratorName"] or not one["PhysicalCores"] or one["Burstable"] == "1":
            continue
        vcpus = int(float(one["vCPUs"]))
        if vcpus in workers:
            kind = (key[0], one["Family"], one["CpuModel"], round(float(one["MemoryGiB"]) / vcpus, 1))
            families[kind][vcpus] = (workers, float(one["PhysicalCores"]) < vcpus)
    return list(families.values())


if __name__ == "__main__":
    main()
