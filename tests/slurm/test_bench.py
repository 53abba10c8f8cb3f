"""`fogspec bench --runner skypilot` on a real SkyPilot over a real Slurm, through the command line."""

import signal
import time

import pytest

from fogspec.effects.disk.specfiles import read_document
from fogspec.manifest import Manifest
from tests.slurm.conftest import ABANDONED
from tests.slurm.site import Site

SHAPES = {"2CPU--4GB": 0.085, "2CPU--16GB": 0.126, "16CPU--32GB": 0.68, "64CPU--128GB": 2.72}


def test_four_shapes_at_once_from_the_spec_to_the_manifest(site: Site, abandoned: float) -> None:
    spec = site.write("shapes", list(SHAPES))
    site.compile(spec)
    begun = time.monotonic()
    bench = site.bench(spec)
    assert bench.ended() == 0
    wall_s = time.monotonic() - begun
    assert site.left(spare=ABANDONED) == []

    records = site.results("shapes")
    assert {name: one.state for name, one in records.items()} == dict.fromkeys(SHAPES, "ok")
    for name, one in records.items():
        cpus = int(name.partition("CPU")[0])
        assert one.requests >= 20
        assert one.setup is not None
        assert one.measuring is not None
        assert one.measuring < one.setup < one.duration
        assert one.latency is not None
        assert one.latency.mean == pytest.approx(0.02 + 0.4 / cpus, rel=0.5), name
        assert one.machine.price == SHAPES[name]
        assert one.spent == pytest.approx(one.duration * SHAPES[name] / 3600)
        assert one.timings is not None
        assert (site.project / "results" / one.timings.path).is_file()
    longest_s = max(one.duration for one in records.values())
    assert wall_s < longest_s + 30, "they ran at the same time"

    site.compile(spec)
    manifest = read_document(site.project / "compiled" / "shapes" / "manifest.yaml", Manifest)
    assert manifest.spec.infra.startswith("slurm/fogtest/")


def test_a_killed_bench_is_finished_by_the_next_one(site: Site) -> None:
    machines = ["2CPU--4GB", "16CPU--32GB"]
    spec = site.write("killed", machines, steps=60)
    site.compile(spec)
    bench = site.bench(spec)
    bench.until(lambda event: event.get("event") == "measures")
    bench.kill()
    assert [name for name in site.jobs() if ABANDONED not in name], "machines run on without their controller"
    assert site.bench(spec, "--resume").ended() == 0
    assert {one.state for one in site.results("killed").values()} == {"ok"}
    attempts = list((site.project / ".fogspec" / "killed" / "attempts").iterdir())
    assert len(attempts) == len(machines), "what ran on was not started again"
    assert site.left(spare=ABANDONED) == []


def test_ctrl_c_in_the_middle_of_a_launch_leaves_nothing(site: Site) -> None:
    spec = site.write("stopped", ["2CPU--4GB", "64CPU--128GB"])
    site.compile(spec)
    bench = site.bench(spec)
    bench.until(lambda event: event.get("event") == "sets up")
    time.sleep(4)
    bench.process.send_signal(signal.SIGINT)
    assert bench.ended() == 130
    assert site.left(spare=ABANDONED) == []
