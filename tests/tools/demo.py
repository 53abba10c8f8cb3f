"""Measure a planner on shapes of this host, choose one, deploy it and end it: `make demo`."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from fogspec.base import units
from fogspec.base.console import say
from fogspec.results.io import read_results_folder

ROOT = Path(__file__).resolve().parents[2]
PROJECT = ROOT / "build" / "demo"
NAME = "planner"
FOGSPEC = [sys.executable, "-m", "fogspec"]
APART = 1.25  # two shapes count as different if one takes so many times as long
REQUIRED = 0.9  # probability, the default of constraints.confidence
SERVING_S = 3.0
SPEC = """\
# A motion planner on this host: eight independent searches per request, a process a CPU, and the shortest path counts.
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: planner}
spec:
  cloud:
    - cmd: [python3, planner.py, --planners, "8", --samples, "1500"]
  probe: {callback: plan}                     # fogspec_probe.start('plan') and .stop('plan', path_length_m=...)
  metrics: {path_length: {callback: path_length_m, unit: m}}
  constraints: {LIMITS}
  hardware: {cpus: 1..16}
  infra: [local]                              # shapes of this host: 1, 2, 4, ... CPUs and their share of its memory
  benchmark: {warmup: 1, stop: {requests: 12, duration: 25s}}
"""


def main() -> int:
    """Run the commands, end with the answer, and return the exit code of the first command that failed."""
    start = time.monotonic()
    say("A motion planner on shapes of this host: measure, choose, deploy, end. About a minute; nothing is rented.")
    prepare()
    for words in (["compile", NAME], ["bench", NAME]):
        if code := run(*words):
            return code
    limit_s = limit_between(means())
    if limit_s is not None:
        write(limit_s)
        say("", f"The robot's limit is set to {units.shown_duration(limit_s)}, between what these shapes take.")
        code = run("compile", NAME)
        # On a busy host the intervals are wide: no shape meets a limit so near with the probability that is required.
        if code or (chosen()["probability"] or 0.0) < REQUIRED:
            limit_s = None
            write(None)
    if limit_s is None and (code := run("compile", NAME)):
        return code
    if code := run("apply", NAME, "--yes"):
        return code
    try:
        time.sleep(SERVING_S)
        for words in (["status", NAME], ["logs", NAME]):
            if code := run(*words):
                return code
    finally:
        ended = run("down", NAME, "--yes")
    if code := ended or run("menu", NAME):
        return code
    say("", *conclusion(limit_s, time.monotonic() - start))
    return 0


def prepare() -> None:
    """Make the project anew; what an interrupted demo left running is ended first."""
    if (PROJECT / ".fogspec").is_dir():
        subprocess.run([*FOGSPEC, "down", NAME, "--yes", "-q"], cwd=PROJECT, check=False)
    shutil.rmtree(PROJECT, ignore_errors=True)
    (PROJECT / "specs").mkdir(parents=True)
    shutil.copy(ROOT / "specs" / "cubicles-planner" / "planner.py", PROJECT / "specs")
    write(None)


def write(limit_s: float | None) -> None:
    """Write the spec with this limit on latency."""
    limits = "{}" if limit_s is None else f"{{latency: {1000 * limit_s:g}ms}}"
    (PROJECT / "specs" / f"{NAME}.yaml").write_text(SPEC.replace("{LIMITS}", limits), "utf-8")


def run(verb: str, *words: str) -> int:
    """Run a command of fogspec's in the project, shown as a user types it; return its exit code."""
    say("", f"$ fogspec {' '.join((verb, *words))}")
    # As in a shell where this environment is active: the planner needs its packages.
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return subprocess.run(
        [*FOGSPEC, verb, *words], cwd=PROJECT, check=False, env={**os.environ, "PATH": path}
    ).returncode


def chosen() -> dict[str, Any]:
    """Return the choice as `menu` gives it to programs."""
    answer = subprocess.run([*FOGSPEC, "menu", NAME, "-o", "json"], cwd=PROJECT, stdout=subprocess.PIPE,
                            stderr=subprocess.DEVNULL, check=False)  # fmt: skip
    return dict(json.loads(answer.stdout)[0]["balanced"])


def means() -> dict[int, float]:
    """Return the mean latency in seconds of each shape that was measured, by its CPUs."""
    samples = read_results_folder(PROJECT / "results" / NAME).spec.samples
    return {round(one.machine.cpus): one.latency.mean for one in samples if one.state == "ok" and one.latency}


def limit_between(mean_s: dict[int, float]) -> float | None:
    """Return a limit that half of the shapes miss, else one at the widest step; None if all take about as long."""
    slowest = sorted(mean_s.values(), reverse=True)
    steps = [(slowest[at - 1] / slowest[at], at) for at in range(1, len(slowest))]
    half = [step for step in steps if step[1] == len(slowest) // 2]
    ratio, at = max(half if half and half[0][0] >= APART else steps, default=(1.0, 0))
    return float(f"{(slowest[at - 1] * slowest[at]) ** 0.5:.2g}") if ratio >= APART else None


def conclusion(limit_s: float | None, took_s: float) -> list[str]:
    """Return what the demo showed on this host, in few lines, or why it showed nothing."""
    mean_s = means()
    curve = ", ".join(f"{cpus} CPU{'s' * (cpus > 1)} {units.shown_duration(mean_s[cpus])}" for cpus in sorted(mean_s))
    choice = chosen()
    shape, interval = choice["instance"], " to ".join(map(units.shown_duration, choice["interval_s"] or ()))
    if limit_s is None:
        cpus, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
        why = "this host has one CPU" if cpus == 1 else f"load {load:.0f} on {cpus} CPUs: run it again when it is idle"
        shown = [f"  no proof   more CPUs did not make a plan clearly faster here; {why}"]
    else:
        missed = sum(one > limit_s for one in mean_s.values())
        shown = [
            f"  limit      {units.shown_duration(limit_s)} per plan: {missed} of {len(mean_s)} shapes miss it",
            f"  chosen     {shape}, not the smallest: {units.shown_duration(choice['latency_s'])}, 90% interval {interval}",
        ]
    return [
        f"In {took_s:.0f} s, on this host:",
        f"  measured   {curve}",
        *shown,
        "  deployed   the shape that was measured, from a manifest that a team reviews; ended, nothing is left",
        f"  next       look at {PROJECT.relative_to(ROOT)}/compiled/{NAME}/latency.svg, then: .venv/bin/fogspec init my-robot",
    ]


if __name__ == "__main__":
    sys.exit(main())
