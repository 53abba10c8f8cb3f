"""A small suite by rule: programs of several serial shares on one family of machines."""

import json
from pathlib import Path

import numpy as np

from tests.support.machines import FAMILIES, SIZES, amdahl, family

SERIAL = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
SETTINGS = (("cheap", 0.0), ("balanced", 0.5), ("fast", 1.0))


def write_suite(folder: Path, problems: int = 2) -> Path:
    """Six workloads, each a suite of its own; problems on the first of them."""
    folder.mkdir(parents=True)
    machines = family()
    families = [name for name in FAMILIES for _ in SIZES]
    lines = ["Cloud,InstanceType,vCPUs,MemoryGiB,Price,Family,Arch,CpuModel"]
    for i, name in enumerate(families):
        shape = f"{machines.vcpus[i]:g},{machines.memory_gib[i]:g},{machines.price_usd_per_hour[i]!r}"
        lines.append(f"aws,m{i},{shape},{name},x86_64,8375C".replace("np.float64(", "").replace(")", ""))
    (folder / "machines.csv").write_text("\n".join(lines) + "\n")
    names = [f"m{i}" for i in range(len(machines))]
    rows = ["workload,suite,cloud,instance_type,latency_s"]
    for w, serial in enumerate(SERIAL):
        rows += [
            f"w{w},s{w},aws,{name},{float(latency)!r}"
            for name, latency in zip(names, amdahl(machines, serial), strict=True)
        ]
    (folder / "latencies.csv").write_text("\n".join(rows) + "\n")
    told = [json.dumps(_problem(w, names, amdahl(machines, SERIAL[w]), machines)) for w in range(problems)]
    (folder / "problems.jsonl").write_text("\n".join(told) + "\n")
    return folder


def _problem(w, names, latency, machines):
    cost = machines.price_usd_per_hour / 3600 * latency
    settings = [
        {
            "name": name,
            "alpha": alpha,
            "max_latency_s": 1.2 * float(np.quantile(latency, 0.6)),  # at a machine's latency no sample would prove it
            "max_cost_usd_per_request": None,
        }
        for name, alpha in SETTINGS
    ]
    return {
        "id": f"family|w{w}", "kind": "family", "workload": f"w{w}", "machines": [f"aws/{name}" for name in names],
        "scale": {"latency_s": float(latency.min()), "cost_usd_per_request": float(cost.min())}, "settings": settings,
    }  # fmt: skip
