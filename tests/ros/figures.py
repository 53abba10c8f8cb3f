"""Every probe against the truth on real ROS 2 nodes, idle and saturated: `python -m tests.ros.figures`.

One node with a known busy time is watched by every probe at once, so that they see the same requests. Error is the median
of what a probe reads minus the median of how long the node was busy; CPU is what a listener used for one request (for the
library inside the node: measured apart, without a middleware); lost is the share of the node's answers it has no record of.
"""

import argparse
import statistics
import tempfile
from pathlib import Path

from tests.ros.namespaces import lacking, network
from tests.ros.quoting import host, quote
from tests.ros.trial import Trial, run
from tests.tools.preload import build, cost_s

CASES = (
    ("service, closed-loop", "service", 0.02, None),
    ("service, saturated", "service", 0.03, 60.0),
    ("action, closed-loop", "action", 0.02, None),
    ("action, saturated", "action", 0.03, 40.0),
    ("topics, idle (10 Hz)", "topic", 0.02, 10.0),
    ("topics, saturated (20 Hz)", "topic", 0.06, 20.0),
)
HEAD = (
    f"{'load':<27}{'probe':<24}{'true ms':>9}{'response':>10}{'service':>9}{'error ms':>10}{'CPU ms':>8}{'lost %':>8}"
)
LIBRARY = "preloaded library"


def main() -> None:
    """Print one line for each load and probe."""
    parser = argparse.ArgumentParser(prog="python -m tests.ros.figures")
    parser.add_argument("--requests", type=int, default=100)
    parser.add_argument("--write", action="store_true", help="into the page that quotes them, too")
    options = parser.parse_args()
    if reason := lacking():
        raise SystemExit(reason)
    with tempfile.TemporaryDirectory() as folder:
        library_s = cost_s(build(Path(folder)))
    lines = [host(), HEAD]
    print(*lines, sep="\n")
    for load, kind, busy_s, rate in CASES:
        with tempfile.TemporaryDirectory() as folder, network(Path(folder)) as net:
            trial = run(net, kind, busy_s, options.requests, rate)
        for probe in trial.records:
            lines.append(line(load, probe, trial, library_s))
            print(lines[-1], flush=True)
    if options.write:
        quote(parser.prog, lines)


def line(load: str, probe: str, trial: Trial, library_s: float) -> str:
    """One probe's figures in milliseconds; `error` is of the service time, or of the latency of one that tells no other."""
    good, true_s = trial.good(probe), statistics.median(trial.truth_s)
    name = {"preload": LIBRARY, "rclpy": "status topic (rclpy)"}.get(probe, f"rclpy, {probe}")
    if not good:
        return f"{load:<27}{name:<24}{1e3 * true_s:9.2f}   nothing was heard"
    response_s, service_s = trial.median_s(probe, "latency_s"), trial.median_s(probe, "service_s")
    # The paper's heuristics have one figure only.
    read_s = response_s if probe in ("first_request", "last_response") else service_s
    cpu_s = library_s if probe == "preload" else trial.cpu_s[probe] / len(good)
    lost = 1 - len(good) / len(trial.truth_s)
    return (f"{load:<27}{name:<24}{1e3 * true_s:9.2f}{1e3 * response_s:10.2f}{1e3 * service_s:9.2f}"
            f"{1e3 * (read_s - true_s):+10.2f}{1e3 * cpu_s:8.3f}{100 * lost:8.1f}")  # fmt: skip


if __name__ == "__main__":
    main()
