"""The bundled catalog: what it holds, that it is small and loads fast, and that its makers still give it."""

import csv
import gzip
import io
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from fogspec.catalog.sources.snapshot import ABOUT, TABLE, Snapshot
from fogspec.catalog.table import Catalog
from tests.unit.relative import work_of

REGIONS = {"us-east-1", "us-east-2", "us-west-1", "us-west-2", "eu-central-1", "eu-west-1", "ap-northeast-1"}


@cache
def snapshot() -> Catalog:
    return Snapshot("", []).load()


@cache
def prices() -> dict[tuple[str, str], float]:
    found = snapshot()
    return dict(zip(zip(found.instance, found.region, strict=True), found.price_usd_per_hour.tolist(), strict=True))


def test_it_says_where_it_comes_from() -> None:
    about = snapshot().about
    assert about.revision == "moto 5.2.5, apache-libcloud 3.9.1"
    assert about.date == "2025-03-02"
    assert about.digest.startswith("sha256:")
    assert any("left out: no price is listed" in note for note in about.notes)


def test_the_papers_nine_machines_cost_what_the_paper_paid() -> None:
    nine = [f"{family}.{size}" for family in ("c6i", "m6i", "r6i") for size in ("large", "4xlarge", "16xlarge")]
    assert sum(prices()[name, "us-east-1"] for name in nine) == pytest.approx(12.587, abs=1e-9)
    assert [prices()[f"g4dn.{size}", "us-west-1"] for size in ("xlarge", "2xlarge", "4xlarge")] == [0.631, 0.902, 1.445]
    assert [prices()[f"g4dn.{size}", "us-east-1"] for size in ("xlarge", "2xlarge", "4xlarge")] == [0.526, 0.752, 1.204]


def test_every_offer_has_a_price_and_a_shape() -> None:
    found = snapshot()
    assert len(found) > 9000
    assert set(found.region) >= REGIONS
    assert set(found.arch) == {"x86_64", "arm64"}
    assert set(found.gpu) >= {"", "T4", "A10G", "L4", "L40S", "T4g"}
    assert (found.price_usd_per_hour > 0).all()
    assert (found.vcpus > 0).all()
    assert (found.memory_gib > 0).all()
    assert (found.physical_cores > 0).all()
    assert len(prices()) == len(found)


def test_it_is_small_and_little_work_to_load() -> None:
    assert TABLE.stat().st_size < 1_000_000
    assert work_of(Snapshot("", []).load, 5) < 25  # the aim is 0.1 s of a machine of 2024


def test_loading_imports_no_scipy() -> None:
    code = "import sys; from fogspec import wiring; wiring.catalog(None, []); sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_an_edited_snapshot_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from fogspec.base.errors import InvalidInput
    from fogspec.catalog.sources import snapshot as module

    edited = gzip.decompress(TABLE.read_bytes()).replace(b",0.085,", b",0.001,", 1)
    (tmp_path / "snapshot.csv.gz").write_bytes(gzip.compress(edited, mtime=0))
    monkeypatch.setattr(module, "TABLE", tmp_path / "snapshot.csv.gz")
    with pytest.raises(InvalidInput, match=r"not the bundled catalog"):
        Snapshot("", []).load()


def test_the_packages_still_give_exactly_this_snapshot() -> None:
    pytest.importorskip("moto", reason="needs the extra fogspec[snapshot]")
    pytest.importorskip("libcloud", reason="needs the extra fogspec[snapshot]")
    command = [sys.executable, "-m", "tools.build_snapshot", "--check"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (made.returncode, made.stdout) == (0, "the snapshot is what these packages give\n")


def test_without_the_packages_the_one_command_is_said() -> None:
    code = "import sys; sys.modules['moto'] = None; from fogspec.catalog.sources import build_snapshot as b; b.main()"
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert made.returncode == 1
    assert "pip install 'fogspec[snapshot]'" in made.stderr
    assert "Traceback" not in made.stderr


def test_the_table_is_reproducible_bytes() -> None:
    raw = TABLE.read_bytes()
    assert raw[4:8] == b"\0\0\0\0"  # gzip's modification time
    assert ABOUT.read_text(encoding="utf-8").endswith("}\n")


def test_prices_and_shapes_agree_with_an_independent_price_list(shared_data: Path) -> None:
    """AWS's us-east-1 list of 2026-07: every machine in both costs the same, but for one rounding."""
    raw = gzip.decompress((shared_data / "catalog/skypilot-v8/aws/vms.csv.gz").read_bytes()).decode()
    other = {row["InstanceType"]: row for row in csv.DictReader(io.StringIO(raw)) if row["Price"]}
    found = snapshot()
    mine = {str(found.instance[i]): i for i in range(len(found)) if found.region[i] == "us-east-1"}
    both = sorted(mine.keys() & other.keys())
    assert len(both) > 700
    assert [name for name in both if abs(prices()[name, "us-east-1"] / float(other[name]["Price"]) - 1) > 2e-3] == [
        "m3.medium"  # 0.067, rounded from 0.0665
    ]
    for name in both:
        row = mine[name]
        assert found.vcpus[row] == float(other[name]["vCPUs"])
        assert found.memory_gib[row] == pytest.approx(float(other[name]["MemoryGiB"]), rel=1e-2)
        assert found.gpu[row] == other[name]["AcceleratorName"]
