"""Run the main job on this host, and end with its conclusion in five lines: `make demo`."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from fogspec.base import units
from fogspec.base.console import say
from fogspec.base.yaml.positions import plain
from fogspec.base.yaml.reader import documents

NAME = "lidar-odometry"
INFEASIBLE = 4
FOGSPEC = [sys.executable, "-m", "fogspec"]
RESULTS = Path("results") / f"{NAME}.yaml"


def main() -> int:
    """Run the commands and print the conclusion; return the exit code of the first one that failed."""
    start = time.monotonic()
    say("Benchmarks LiDAR odometry on this host's CPUs and chooses a cloud machine: about a minute, nothing is rented.")
    steps = (["validate"], ["compile"], ["bench", "--runner", "local"], ["compile"], ["report"])
    for verb, *options in steps:
        words = [verb, NAME, *options]
        say("", f"$ fogspec {' '.join(words)}")
        code = subprocess.run([*FOGSPEC, *words], check=False).returncode
        if code not in (0, INFEASIBLE):
            return code
    say("", f"Conclusion, after {time.monotonic() - start:.0f} s", *conclusion())
    return 0


def conclusion() -> list[str]:
    """Return what was measured, what was chosen, how sure that is, what it costs, and what comes next."""
    answer = subprocess.run(
        [*FOGSPEC, "menu", NAME, "-o", "json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=False
    )
    menu: dict[str, Any] = json.loads(answer.stdout)[0]
    found, _ = documents(RESULTS.read_text("utf-8"), str(RESULTS))
    samples = [one for one in plain(found[0])["spec"]["samples"] if one["state"] == "ok"]
    means = sorted(units.parse_duration_s(one["latency"]["mean"]) for one in samples)
    count, requests = len(samples), sum(one["requests"] for one in samples)
    range_ = f"{units.shown_duration(means[0])} to {units.shown_duration(means[-1])} per scan" if means else "none"
    rows = [("measured", f"{count} shapes of this host, {requests} scans: {range_}")]
    entry = menu["balanced"] or menu["nearest"]
    if entry is None:
        return _rows([*rows, ("chosen", "nothing: no sample counts"), ("next", f"fogspec bench {NAME} --runner local")])
    latency, limit = (units.shown_duration(seconds) for seconds in (entry["latency_s"], menu["limits"]["latency_s"]))
    met = f"within the limit of {limit}" if menu["balanced"] else "no machine meets the limits"
    price, cost = entry["price_usd_per_hour"], units.shown_cost(entry["cost_usd_per_request"])
    return _rows(
        [
            *rows,
            ("chosen" if menu["balanced"] else "nearest", f"{entry['instance']} in {entry['infra']}: {latency}, {met}"),
            ("confidence", "low: extrapolated from this host's CPUs; measure on the cloud before you rent"),
            ("cost", f"{cost}; {units.shown_price(price)}, {units.shown_month(entry['usd_per_month'])}"),
            ("next", f"open compiled/{NAME}/report.html, then write your own spec: .venv/bin/fogspec init my-robot"),
        ]
    )


def _rows(rows: list[tuple[str, str]]) -> list[str]:
    return [f"  {name:<11} {text}" for name, text in rows]


if __name__ == "__main__":
    sys.exit(main())
