"""Figures of the runner on a real SkyPilot: over a real Slurm, `make slurm-figures`; tests.aws.figures has AWS's.

What a cloud adds to it is the time that its machines take to boot; what is printed is SkyPilot's and fogspec's own.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.slurm.site import Site, recorded
from tests.tools import apart

STARTS_S = 600.0
SHAPES = ("2CPU--4GB", "2CPU--16GB", "16CPU--32GB", "64CPU--128GB")


def main(kind: type[Site] = Site, shapes: Sequence[str] = SHAPES) -> None:
    """Measure shapes one after the other and all at once, and deploy one, beside an engine."""
    with tempfile.TemporaryDirectory() as scratch:
        _figures(kind(Path(os.environ[apart.FOLDER]), Path(scratch) / "project"), shapes)


def _figures(site: Site, shapes: Sequence[str]) -> None:
    print(f"load of this computer before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs")
    begun = time.monotonic()
    spec = site.write("warm", list(shapes[:1]))
    while "SkyPilot has access" not in site.run("bench", spec, "--dry-run", code=None).stdout:
        if time.monotonic() > begun + STARTS_S:
            raise SystemExit("SkyPilot's API server did not start")
    print(f"SkyPilot's API server started, and asked for access, after {time.monotonic() - begun:.1f} s")
    one = _bench(site, "single", shapes[:1])
    record = next(iter(site.results("single").values()))
    measuring = record.measuring or 0
    print(
        f"one sample: {one:.1f} s, of which {measuring:.1f} s measuring, so {one - measuring:.1f} s overhead; "
        f"paid for {record.duration:.1f} s"
    )
    many = _bench(site, "many", shapes)
    longest = max(record.duration for record in site.results("many").values())
    print(
        f"{len(shapes)} samples at once: {many:.1f} s; the longest was paid for {longest:.1f} s: {many / longest:.2f} of "
        f"that; {len(shapes) * one / many:.1f} times as fast as so many samples one after the other"
    )
    _applied(site, shapes[0])
    print(f"left: {len(site.left())} machines")


STARTED = """
import json, sys, sky
print(json.dumps(sky.get(sky.queue(sys.argv[1], all_users=True))[0]["start_at"]))
"""


def _applied(site: Site, shape: str, runs: int = 3) -> None:
    """From the start of `apply` to the first answered request: whose time it is, in the middle one of some runs."""
    spec = site.write("served", [shape])
    site.compile(spec)
    recorded(site, "served")
    site.compile(spec)
    each = sorted((_shares(site, spec) for _ in range(runs)), key=sum)
    asked, given, answered, said = each[runs // 2]
    print(
        f"from apply to the first answered request: {asked + given + answered:.1f} s, of which SkyPilot's {given:.1f} s "
        f"from its first question to the job; the rest, {asked + answered:.1f} s: {asked:.1f} s of checks and "
        f"{answered:.1f} s of the nodes; apply says so {said:.1f} s later ({runs} runs)"
    )


def _shares(site: Site, spec: str) -> tuple[float, float, float, float]:
    """Seconds until SkyPilot is asked, to the job, to the first answered request, and until `apply` has ended."""
    begun = time.time()
    words = site._argv(("apply", "compiled/served/manifest.yaml", "--yes", "-o", "json"))
    with subprocess.Popen(words, cwd=site.project, env=site._env(), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          text=True) as apply:  # fmt: skip
        assert apply.stderr is not None
        assert apply.stdout is not None
        asked = next(time.time() for line in apply.stderr if "/month" in line)  # all is checked; now SkyPilot is asked
        apply.stderr.read()
        name = json.loads(apply.stdout.read())["name"]
    ended = time.time()
    queue = [sys.executable, "-c", STARTED, name]
    started = float(
        subprocess.run(queue, env=site._env(), capture_output=True, text=True, check=True).stdout.splitlines()[-1]
    )
    live = json.loads(site.run("status", spec, "-o", "json").stdout)[0]["deployment"]
    site.run("down", "served")
    answered = started + live["ready_s"]
    return asked - begun, started - asked, live["ready_s"], ended - answered


def _bench(site: Site, name: str, shapes: Sequence[str]) -> float:
    spec = site.write(name, list(shapes), steps=100)
    site.compile(spec)
    begun = time.monotonic()
    if code := site.bench(spec).ended():
        raise SystemExit(f"{name}: exit code {code}\n{(site.project / 'bench.log').read_text()[-3000:]}")
    return time.monotonic() - begun


if __name__ == "__main__":
    main()
