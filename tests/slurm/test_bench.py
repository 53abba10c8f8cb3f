"""`fogspec bench --runner skypilot` on a real SkyPilot over a real Slurm, through the command line."""

import gzip
import tempfile
from pathlib import Path

import pytest

from fogspec.compile.manifest import Manifest
from fogspec.language.loader import read_document
from fogspec.results.io import read_results_folder, timings_path
from tests.slurm.abandoned import ABANDONED
from tests.slurm.conftest import SECRET, SHAPES, Benched
from tests.slurm.looking import holding
from tests.slurm.site import Site, recorded


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
        assert max(one.measuring, one.setup) < one.duration
        assert one.latency is not None
        assert one.latency.mean >= 0.99 * (0.02 + 0.4 / cpus), name
        assert one.machine.price == SHAPES[name]
        assert one.spent == pytest.approx(one.duration * SHAPES[name] / 3600)
        assert one.timings is not None
        assert timings_path(site.project / "results" / "life", one.id).is_file()
    assert benched.at_once == len(SHAPES)
    manifest = read_document(site.project / "compiled" / "life" / "manifest.yaml", Manifest)
    assert manifest.spec.infra.startswith("slurm/fogtest/")


@pytest.mark.rare
def test_one_machine_measured_again_confirms_results_from_before_a_change(site: Site) -> None:
    path = site.project / (spec := site.write("changed", [small := "2CPU--4GB"]))
    path.write_text(path.read_text().replace("alpha: 0.5", "alpha: 0").replace("cpus: 1..128", "cpus: 2"))
    site.compile(spec)
    recorded(site, "changed")
    site.compile(spec)
    path.write_text(path.read_text().replace("[python3, work.py]", "[python3, work.py, --quiet]"))
    site.compile(spec)
    bench = site.bench(spec)
    code = bench.ended()
    body = read_results_folder(site.project / "results" / "changed").spec
    measured = next(one for one in body.samples if one.timings is not None)
    assert (measured.machine.instance, measured.state) == (small, "ok")
    if code == 0:
        (carried,) = body.carried
        assert carried.confirmed is not None
        assert carried.confirmed.sample == measured.id
        assert carried.confirmed.changes == ['spec.cloud[0].cmd: [python3, work.py] -> [python3, work.py, "--quiet"]']
        site.compile(spec)
        assert "confirmed: " in (site.project / "compiled" / "changed" / "manifest.yaml").read_text()
    else:  # this host was so busy that it measured another latency
        assert code == 3
        assert (site.project / "results" / "changed.old-1").is_dir()
    assert site.left(spare=ABANDONED) == []


def test_a_secret_reaches_the_workload_and_is_in_no_file_and_on_no_command_line(benched: Benched) -> None:
    site, seen = benched.site, benched.seen
    assert holding(site.project.rglob("*"), SECRET) == []
    kept = [path for name in ("sky", "home", "log", "ctld", "tmp") for path in (site.cluster / name).rglob("*")]
    # SkyPilot leaves the scripts of jobs in the node's folder for temporary files; ours leaves nothing there.
    kept += [one for names in ("sky_app_*", "fogspec-*.secrets") for one in Path(tempfile.gettempdir()).glob(names)]
    assert len(kept) > 50
    assert holding(kept, SECRET) == [], "neither SkyPilot nor Slurm nor the node keeps it"
    assert seen.told == set()
    for one in site.results("life").values():
        assert one.timings is not None
        packed = timings_path(site.project / "results" / "life", one.id)
        assert b"refused $MAP_PASSWORD" in gzip.decompress(packed.read_bytes()), "the workload had it"


def test_on_a_machine_fogspec_listens_on_no_port_and_lets_nobody_write(benched: Benched) -> None:
    seen = benched.seen
    assert seen.seen == {"agent.pyz", "work.py"}, "both were looked at"
    assert [name for name, ours in seen.ports if ours] == []
    assert "skylet" in {name for name, _ in seen.ports}, "what SkyPilot runs there is seen"
    assert seen.writable == set()
