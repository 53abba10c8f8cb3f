"""Figures of the runner on a real SkyPilot over a real Slurm: `make slurm-figures`.

What a cloud adds to it is the time that its machines take to boot; what is printed is SkyPilot's and fogspec's own.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.slurm.site import Site, recorded
from tests.tools import apart

SHAPES = ("2CPU--4GB", "2CPU--16GB", "16CPU--32GB", "64CPU--128GB")


def main() -> None:
    """Measure four shapes one after the other and all at once, beside a cluster."""
    with tempfile.TemporaryDirectory() as scratch:
        _figures(Site(Path(os.environ[apart.FOLDER]), Path(scratch) / "project"))


def _figures(site: Site) -> None:
    warm = _bench(site, "warm", SHAPES[:1])  # starts the API server, which stays
    print(f"first bench, with the start of SkyPilot's API server: {warm:.1f} s")
    one = _bench(site, "single", SHAPES[:1])
    record = next(iter(site.results("single").values()))
    print(
        f"one sample: {one:.1f} s, of which {record.measuring or 0:.1f} s measuring; paid for {record.duration:.1f} s"
    )
    many = _bench(site, "many", SHAPES)
    longest = max(record.duration for record in site.results("many").values())
    ratio = many / longest
    print(f"{len(SHAPES)} samples at once: {many:.1f} s; the longest was paid for {longest:.1f} s: {ratio:.2f} of that")
    _applied(site)
    print(f"left: {len(site.left())} machines")


STARTED = """
import json, sys, sky
print(json.dumps(sky.get(sky.queue(sys.argv[1], all_users=True))[0]["start_at"]))
"""


def _applied(site: Site, runs: int = 3) -> None:
    """From the start of `apply` to the first answered request: whose time it is, in the middle one of some runs."""
    spec = site.write("served", list(SHAPES[:1]))
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
    words = site._argv(("apply", "compiled/served/manifest.yaml", "--catalog", site.prices, "--yes", "-o", "json"))
    with subprocess.Popen(words, cwd=site.project, env=site._env(), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          text=True) as apply:  # fmt: skip
        assert apply.stderr is not None
        assert apply.stdout is not None
        asked = next(time.time() for line in apply.stderr if "a month" in line)  # all is checked; now SkyPilot is asked
        apply.stderr.read()
        name = json.loads(apply.stdout.read())["name"]
    ended = time.time()
    queue = [sys.executable, "-c", STARTED, name]
    started = float(
        subprocess.run(queue, env=site._env(), capture_output=True, text=True, check=True).stdout.splitlines()[-1]
    )
    live = json.loads(site.run("status", spec, "--catalog", site.prices, "-o", "json").stdout)[0]["deployment"]
    site.run("down", "served")
    answered = started + live["ready_s"]
    return asked - begun, started - asked, live["ready_s"], ended - answered


def _bench(site: Site, name: str, shapes: tuple[str, ...]) -> float:
    spec = site.write(name, list(shapes), steps=100)
    site.compile(spec)
    begun = time.monotonic()
    if code := site.bench(spec).ended():
        raise SystemExit(f"{name}: exit code {code}, see {site.project / 'bench.log'}")
    return time.monotonic() - begun


if __name__ == "__main__":
    main()
