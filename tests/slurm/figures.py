"""Figures of the runner on a real SkyPilot over a real Slurm: `make slurm-figures`.

What a cloud adds to it is the time that its machines take to boot; what is printed is SkyPilot's and fogspec's own.
"""

import os
import tempfile
import time
from pathlib import Path

from tests.slurm.site import Site
from tests.tools.slurm import apart

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
    print(f"left: {len(site.left())} machines")


def _bench(site: Site, name: str, shapes: tuple[str, ...]) -> float:
    spec = site.write(name, list(shapes), steps=100)
    site.compile(spec)
    begun = time.monotonic()
    if code := site.bench(spec).ended():
        raise SystemExit(f"{name}: exit code {code}, see {site.project / 'bench.log'}")
    return time.monotonic() - begun


if __name__ == "__main__":
    main()
