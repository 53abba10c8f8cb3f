"""`fogspec bench --runner skypilot` on a real SkyPilot over a real Slurm, through the command line."""

import pytest

from fogspec.effects.disk.specfiles import read_document
from fogspec.manifest import Manifest
from tests.slurm.conftest import SHAPES, Benched


def test_four_shapes_at_once_from_the_spec_to_the_manifest(benched: Benched) -> None:
    site = benched.site
    assert benched.left == []
    records = site.results("life")
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
    assert benched.took_s < longest_s + 30, "they ran at the same time"
    manifest = read_document(site.project / "compiled" / "life" / "manifest.yaml", Manifest)
    assert manifest.spec.infra.startswith("slurm/fogtest/")
