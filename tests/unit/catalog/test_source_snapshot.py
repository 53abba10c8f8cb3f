"""The bundled catalog: what it holds, that it is small and loads fast, and that its makers still give it."""

import csv
import gzip
import io
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from fogspec.base.layout import Layout
from fogspec.catalog.sources.snapshot import ABOUT, TABLE, Snapshot
from fogspec.catalog.table import Catalog
from fogspec.results.io import read_results
from tests.conftest import ROOT, SHARED
from tests.support.relative import work_of

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


@pytest.mark.slow
def test_loading_imports_no_scipy() -> None:
    code = "import sys; from fogspec.catalog import sources; sources.load_catalog(None, []); sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_an_edited_snapshot_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from fogspec.base.errors import InvalidInput
    from fogspec.catalog.sources import snapshot as module

    edited = gzip.decompress(TABLE.read_bytes()).replace(b",0.085,", b",0.001,", 1)
    (tmp_path / "snapshot.csv.gz").write_bytes(gzip.compress(edited, mtime=0))
    monkeypatch.setattr(module, "TABLE", tmp_path / "snapshot.csv.gz")
    with pytest.raises(InvalidInput, match=r"not the bundled catalog"):
        Snapshot("", []).load()


@pytest.mark.slow
def test_the_packages_still_give_exactly_this_snapshot() -> None:
    pytest.importorskip("moto", reason="needs the development environment")
    pytest.importorskip("libcloud", reason="needs the development environment")
    command = [sys.executable, "-m", "fogspec_lab", "snapshot", "--check"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (made.returncode, made.stdout) == (0, "the snapshot is what these packages give\n")


@pytest.mark.slow
def test_without_the_packages_the_one_command_is_said() -> None:
    code = "import sys; sys.modules['moto'] = None; from fogspec_lab.cli import main; main(['snapshot'])"
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert made.returncode == 1
    assert "pip install moto apache-libcloud" in made.stderr
    assert "Traceback" not in made.stderr


def test_the_table_is_reproducible_bytes() -> None:
    raw = TABLE.read_bytes()
    assert raw[4:8] == b"\0\0\0\0"  # gzip's modification time
    assert ABOUT.read_text(encoding="utf-8").endswith("}\n")


@dataclass(frozen=True)
class PriceList:
    """Prices and shapes in us-east-1 from elsewhere: by instance type, USD per hour, vCPUs, GiB and GPU."""

    offers: Callable[[], dict[str, tuple[float, float, float, str]]]
    at_least: int
    rounded: tuple[str, ...] = ()


def papers_list() -> dict[str, tuple[float, float, float, str]]:
    """What the paper's authors paid for in 2023, as `results/` restates it."""
    results = [read_results(Layout.of(ROOT / "specs" / "x.yaml", path.stem)) for path in PAPER]
    machines = [sample.machine for one in results for sample in one.spec.samples]
    return {m.instance: (m.price, m.cpus, m.memory, m.gpu.name if m.gpu else "") for m in machines}


def aws_list() -> dict[str, tuple[float, float, float, str]]:
    """AWS's list of 2026-07."""
    text = gzip.decompress(AWS_LIST.read_bytes()).decode()
    return {
        row["InstanceType"]: (
            float(row["Price"]), float(row["vCPUs"]), float(row["MemoryGiB"]), row["AcceleratorName"]
        )
        for row in csv.DictReader(io.StringIO(text)) if row["Price"]
    }  # fmt: skip


PAPER = sorted(
    {path.parent for path in (ROOT / "results").glob("*/*.yaml") if "runner: recorded" in path.read_text("utf-8")}
)
AWS_LIST = SHARED / "data" / "catalog" / "skypilot-v8" / "aws" / "vms.csv.gz"
PRICE_LISTS = {"paper": PriceList(papers_list, at_least=12)}
if AWS_LIST.is_file():
    PRICE_LISTS["aws"] = PriceList(aws_list, at_least=700, rounded=("m3.medium",))  # 0.067, rounded from 0.0665


@pytest.mark.parametrize("name", PRICE_LISTS)
def test_prices_and_shapes_agree_with_independent_price_lists(name: str) -> None:
    """Every machine in both costs the same, but for rounding."""
    other = PRICE_LISTS[name].offers()
    found = snapshot()
    mine = {str(found.instance[i]): i for i in range(len(found)) if found.region[i] == "us-east-1"}
    both = sorted(mine.keys() & other.keys())
    assert len(both) >= PRICE_LISTS[name].at_least
    differing = [one for one in both if abs(prices()[one, "us-east-1"] / other[one][0] - 1) > 2e-3]
    assert differing == list(PRICE_LISTS[name].rounded)
    for one in both:
        _, vcpus, memory_gib, gpu = other[one]
        assert found.vcpus[mine[one]] == vcpus
        assert found.memory_gib[mine[one]] == pytest.approx(memory_gib, rel=1e-2)
        assert found.gpu[mine[one]] == gpu
