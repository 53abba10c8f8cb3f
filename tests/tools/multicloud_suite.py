"""Selection problems over the machines of several clouds, for `fogspec evaluate --suite`.

`python -m tests.tools.multicloud_suite SOURCE FOLDER [PROGRAMS [EVERY]]` makes them from the machines and latencies of a
folder such as a library of performance priors, which is not here. Of the programs that were measured on machines of three
clouds, one of each suite in turn is picked, in an order by digest of their names. With EVERY a problem has one in so many
machines, by digest, and is replayed in a fraction of the time. Limits and scales are quantiles of what the machines have.
"""

import csv
import gzip
import hashlib
import io
import json
import statistics
import sys
from collections import defaultdict
from pathlib import Path

COUNT = 6
FEWEST = 2000  # machines of a problem
Row = dict[str, str]


def main(source: Path, folder: Path, programs: int = COUNT, every: int = 1) -> None:
    """Write the suite."""
    machines = {f"{one['Cloud']}/{one['InstanceType']}": one for one in _rows(source / "machines.csv") if _plain(one)}
    latency_s: dict[str, dict[str, float]] = defaultdict(dict)
    suites: dict[str, str] = {}
    for one in _rows(source / "latencies.csv.gz"):
        name = f"{one['cloud']}/{one['instance_type']}"
        if name in machines:
            latency_s[one["workload"]][name] = float(one["latency_s"])
            suites[one["workload"]] = one["suite"]
    folder.mkdir(parents=True, exist_ok=True)
    picked = _picked(latency_s, suites, programs)
    problems = [_problem(workload, _some(workload, latency_s[workload], every), machines) for workload in picked]
    (folder / "machines.csv").write_text(_csv(list(machines.values())))
    rows = []
    for workload in picked:
        for name, seconds in latency_s[workload].items():
            cloud, _, instance = name.partition("/")
            rows.append(
                {
                    "workload": workload,
                    "suite": suites[workload],
                    "cloud": cloud,
                    "instance_type": instance,
                    "latency_s": repr(seconds),
                }
            )
    (folder / "latencies.csv").write_text(_csv(rows))
    (folder / "problems.jsonl").write_text("".join(json.dumps(one) + "\n" for one in problems))


def _plain(machine: Row) -> bool:
    return not machine["AcceleratorName"] and machine["Burstable"] == "0" and float(machine["Price"]) > 0


def _some(workload: str, latency_s: dict[str, float], every: int) -> dict[str, float]:
    """Return the latencies of one in `every` machines."""
    digests = {name: int(hashlib.sha256((workload + name).encode()).hexdigest(), 16) for name in latency_s}
    return {name: seconds for name, seconds in latency_s.items() if digests[name] % every == 0}


def _picked(latency_s: dict[str, dict[str, float]], suites: dict[str, str], programs: int) -> list[str]:
    left: dict[str, list[str]] = defaultdict(list)
    for workload in sorted(latency_s, key=lambda name: hashlib.sha256(name.encode()).hexdigest()):
        found = latency_s[workload]
        if len(found) >= FEWEST and len({name.partition("/")[0] for name in found}) >= 3:
            left[suites[workload]].append(workload)
    picked: list[str] = []
    while len(picked) < programs and any(left.values()):
        picked += [some.pop(0) for some in left.values() if some]
    return picked[:programs]


def _problem(workload: str, latency_s: dict[str, float], machines: dict[str, Row]) -> dict[str, object]:
    names = sorted(latency_s)
    cost = {name: float(machines[name]["Price"]) / 3600 * latency_s[name] for name in names}
    fast, cheap = (statistics.quantiles(some.values(), n=10, method="inclusive") for some in (latency_s, cost))
    settings = [
        ("a0", 0.0, None, None), ("a.5", 0.5, None, None), ("a1", 1.0, None, None), ("a0_L50", 0.0, fast[4], None),
        ("a0_L20", 0.0, fast[1], None), ("a1_C50", 1.0, None, cheap[4]), ("a1_C20", 1.0, None, cheap[1]),
    ]  # fmt: skip
    keys = ("name", "alpha", "max_latency_s", "max_cost_usd_per_request")
    return {
        "id": f"multicloud|{workload}",
        "kind": "multicloud",
        "workload": workload,
        "machines": names,
        "scale": {"latency_s": fast[4], "cost_usd_per_request": cheap[4]},
        "settings": [dict(zip(keys, one, strict=True)) for one in settings],
    }


def _rows(path: Path) -> list[Row]:
    raw = path.read_bytes()
    text = gzip.decompress(raw).decode() if path.suffix == ".gz" else raw.decode()
    return list(csv.DictReader(io.StringIO(text)))


def _csv(rows: list[Row]) -> str:
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
