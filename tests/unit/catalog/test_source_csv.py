"""A catalog from a file: what is understood, what is left out aloud, and where a wrong file is wrong."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import InvalidInput
from fogspec.catalog.sources import load_catalog
from tests.support.catalogs import HEAD, table

GOOD = "c6i.large,,,2,4,0.085,,us-east-1,"


def load(tmp_path: Path, content: bytes, name: str = "aws.csv") -> object:
    path = tmp_path / name
    path.write_bytes(content)
    return load_catalog(str(path), [])


@pytest.mark.parametrize(
    ("content", "line", "column", "says"),
    [
        (b"", 1, 1, "empty"),
        (b"InstanceType,MemoryGiB,Price\n", 1, 1, "missing: vCPUs, Region"),
        (b"InstanceType,vCPUs,MemoryGiB,Region\nc6i.large,2,4,us-east-1\n", 1, 1, "machines of aws have prices"),
        (
            b"Cloud,InstanceType,vCPUs,MemoryGiB,price,Region\nslurm,s,2,4,1,lab\n",
            1,
            1,
            "Price, in USD per hour: it has price",
        ),
        (f"{HEAD}\n".encode(), 1, 1, "at least one row"),
        (f"{HEAD},Price\n".encode(), 1, 1, "a column must stand once: Price"),
        (f"{HEAD}\n{GOOD}\nc6i.xlarge,,,four,8,0.17,,us-east-1,\n".encode(), 3, 14, "vCPUs must be a number"),
        (f"{HEAD}\n\n{GOOD}\n\nc6i.xlarge,,,4,8,-0.17,,us-east-1,\n".encode(), 5, 18, "Price must be a number"),
        (f'{HEAD}\n"c6i,x",,,4,8,1e999,,us-east-1,\n'.encode(), 2, 15, "Price must be a number"),
        (f"{HEAD}\n{GOOD}\nc6i.xlarge,,,4\n".encode(), 3, 1, "9 fields like the header, not 4"),
        (f'{HEAD}\n"c6i.large,,,2\n'.encode(), 2, 1, "not CSV"),
        (f"{HEAD}\nc6i.l\xe4rge,,,2,4,1,,us-east-1,\n".encode("latin-1"), 2, 6, "UTF-8"),
    ],
)
def test_a_wrong_file_is_located(tmp_path: Path, content: bytes, line: int, column: int, says: str) -> None:
    with pytest.raises(DiagnosticError) as caught:
        load(tmp_path, content)
    [found] = caught.value.diagnostics
    assert (found.span.line, found.span.column) == (line, column)
    assert found.span.path.endswith("aws.csv")
    assert says in found.message


def test_own_machines_without_a_column_of_prices_cost_core_hours(tmp_path: Path) -> None:
    content = b"Cloud,InstanceType,vCPUs,MemoryGiB,Region\nslurm,s,2,4,lab\nslurm,l,64,128,lab\nslurm,m,16,32,lab\n"
    found = load(tmp_path, content, "lab.csv")
    assert found.price_usd_per_hour.tolist() == found.vcpus.tolist() == [64, 16, 2]  # type: ignore[attr-defined]
    assert found.about.core_hours  # type: ignore[attr-defined]
    [note] = found.about.notes  # type: ignore[attr-defined]
    assert note.endswith("lab.csv: no column Price: costs are core-hours (core-h), and $1 in a spec stands for one")


def test_all_mistakes_are_told_at_once_in_order(tmp_path: Path) -> None:
    rows = ["a.large,,,x,4,0.1,,r,", "b.large,,,2,y,z,,r,"]
    with pytest.raises(DiagnosticError) as caught:
        load(tmp_path, "\n".join([HEAD, *rows]).encode())
    assert [(d.span.line, d.span.column) for d in caught.value.diagnostics] == [(2, 11), (3, 13), (3, 15)]


def test_a_truncated_gzip_a_missing_file_and_a_folder_are_no_traceback(tmp_path: Path) -> None:
    whole = gzip.compress(f"{HEAD}\n{GOOD}\n".encode())
    for content in (whole[:-9], b"no gzip at all", whole[:20]):
        with pytest.raises(InvalidInput, match="not a complete gzip"):
            load(tmp_path, content, "aws.csv.gz")
    with pytest.raises(InvalidInput, match="No such file"):
        load_catalog(str(tmp_path / "absent.csv"), ["aws"])
    with pytest.raises(InvalidInput, match="has no table of aws"):
        load_catalog(str(tmp_path), ["aws"])


def test_the_cloud_is_in_the_table_or_in_the_names_or_must_be_said(tmp_path: Path) -> None:
    content = f"{HEAD}\n{GOOD}\n".encode()
    assert load(tmp_path, content, "azure.csv").cloud[0] == "azure"  # type: ignore[attr-defined]
    (tmp_path / "gcp").mkdir()
    assert load(tmp_path / "gcp", content, "vms.csv").cloud[0] == "gcp"  # type: ignore[attr-defined]
    with pytest.raises(DiagnosticError, match="column Cloud is missing"):
        load(tmp_path, content, "offers.csv")
    assert load_catalog(str(tmp_path / "offers.csv"), ["lambda"]).cloud[0] == "lambda"


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("c6i.xlarge,,,4,8,,,us-east-1,", "no price"),
        ("c6i.xlarge,,,4,8,0.0,,us-east-1,", "a price of 0"),
        ("c6i.xlarge,,,,8,0.17,,us-east-1,", "no vCPUs or no memory"),
        ("c6i.xlarge,,,4,0,0.17,,us-east-1,", "no vCPUs or no memory"),
        ("g6f.large,L4,0,2,8,0.2,,us-east-1,", "an accelerator without a count"),
    ],
)
def test_what_has_no_price_or_shape_is_no_candidate_and_said(row: str, says: str) -> None:
    catalog = table(GOOD, row)
    assert catalog.instance.tolist() == ["c6i.large"]
    [note] = catalog.about.notes
    assert note.startswith(f"offers.csv: 1 row has {says}")
    assert note.endswith(f"such as {row.split(',')[0]} at line 3")


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (
            ["a,,,4,15800,0.1,,r,", "b,,,16,63900,0.4,,r,"],
            "2: MemoryGiB makes it 3,950 GiB per vCPU, as in 2 rows: is it in MB?",
        ),
        (["a,,,64,0.25,0.1,,r,"], "2: MemoryGiB makes it 0.003906 GiB per vCPU: is it in TB?"),
        ([GOOD, "a,,,4000,16,0.1,,r,"], "3: vCPUs makes it 4,000 vCPUs: is it in thousandths of one?"),
        (
            ["a,T4,1,4,16,0.1,,r,,15360", "b,T4,1,4,16,0.1,,r,,15"],
            "3: GpuMemMiB makes it 0.01465 GiB per accelerator: is it in GiB?",
        ),
        (
            ["a,,,2,4,0.1,,r,", "b,,,2,4,0.1,,r,", "c,,,2,4,72,,r,"],
            "4: Price makes it 720 times the median price per vCPU: is it in cents, or USD per month?",
        ),
        (
            ["a,,,2,4,0.1,,r,", "b,,,2,4,0.1,,r,", "c,,,2,4,3e-5,,r,"],
            "4: Price makes it 0.0003 times the median price per vCPU: is it in USD per minute or second?",
        ),
    ],
)
def test_sizes_that_no_machine_has_are_a_warning_with_the_likely_unit(rows: list[str], says: str) -> None:
    head = HEAD + ",GpuMemMiB" * ("T4" in rows[0])
    assert table(*rows, head=head).about.notes == (f"warning: offers.csv:{says}",)


def test_the_memory_of_an_accelerator_is_in_gib_where_skypilots_list_has_gib() -> None:
    info = "\"{'Gpus': [{'MemoryInfo': {'SizeInMiB': %d}}]}\""
    rows = [f"a,A40,1,4,16,0.1,,r,,{info % 48}", f"b,A40,1,4,16,0.1,,r,,{info % 49152}"]
    found = table(*rows, head=HEAD + ",GpuInfo")
    assert found.gpu_memory_gib.tolist() == [48, 48]
    assert found.about.notes == ()


def test_two_sizes_of_one_type_are_said() -> None:
    rows = ["D8as,,,8,32,0.344,,westus3,", "D8as,,,8,64,0.344,,westus3,"]
    said = table(*rows).about.notes
    assert (
        said[1]
        == "warning: offers.csv: D8as has two sizes: the size of the cheaper row counts, at one price the smaller"
    )
    assert table(*rows).memory_gib.tolist() == table(*reversed(rows)).memory_gib.tolist() == [32]
    assert len(table(rows[0], rows[0], rows[1].replace("D8as", "D16as")).about.notes) == 1


@pytest.mark.parametrize("text", ["1_000", "\uff12", "0x10"])
def test_a_number_is_one_as_in_a_spec(text: str) -> None:
    with pytest.raises(DiagnosticError, match="vCPUs must be a number"):
        table(f"a,,,{text},4,0.1,,r,")


def test_a_repeated_offer_counts_once_at_its_highest_price() -> None:
    catalog = table(GOOD, GOOD, "c6i.large,,,2,4,0.095,,us-east-1,")
    assert catalog.price_usd_per_hour.tolist() == [0.095]
    assert catalog.about.notes == ("offers.csv: 2 offers are repeated: the highest price of each counts",)


def test_spot_machines_are_offers_of_their_own() -> None:
    catalog = table("c6i.large,,,2,4,0.085,0.03,us-east-1,use1-az2", "c6i.xlarge,,,4,8,0.17,0,us-east-1,use1-az2")
    assert list(zip(catalog.instance, catalog.spot.tolist(), catalog.price_usd_per_hour.tolist(), strict=True)) == [
        ("c6i.large", False, 0.085), ("c6i.xlarge", False, 0.17), ("c6i.large", True, 0.03),
    ]  # fmt: skip
    assert "1 row has a spot price of 0: not a spot candidate" in catalog.about.notes[0]


def test_the_order_of_rows_changes_nothing() -> None:
    rows = ["c6i.large,,,2,4,0.085,0.02,us-east-1,a", "g4dn.xlarge,T4,1,4,16,0.526,,us-east-1,b", GOOD]
    one, other = table(*rows), table(*reversed(rows))
    assert one.about == other.about
    assert all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("instance", "zone", "spot"))


def test_architecture_and_family_come_from_the_name_where_the_table_is_silent() -> None:
    catalog = table("c7g.large,,,2,4,1,,r,", "m6i.large,,,2,8,1,,r,", "g5g.xlarge,T4g,1,4,8,1,,r,")
    assert dict(zip(catalog.instance, catalog.arch, strict=True)) == {
        "c7g.large": "arm64", "m6i.large": "x86_64", "g5g.xlarge": "arm64",
    }  # fmt: skip
    assert sorted(catalog.family) == ["c7g", "g5g", "m6i"]


def test_google_hosts_and_accelerators_are_joined_at_the_sum_of_their_prices() -> None:
    catalog = table(
        "n1-standard-4,,,4,15,0.19,0.04,us-central1,us-central1-a",
        "n1-standard-96,,,96,360,4.56,,us-central1,us-central1-a",
        "a2-highgpu-1g,,,12,85,0.75,,us-central1,us-central1-a",
        ",T4,1,,,0.35,0.14,us-central1,us-central1-a",
        ",A100,1,,,2.93,,us-central1,us-central1-a",
        cloud="gcp",
    )
    found = {(str(i), str(g), bool(s)): round(float(p), 4) for i, g, s, p in zip(
        catalog.instance, catalog.gpu, catalog.spot, catalog.price_usd_per_hour, strict=True)}  # fmt: skip
    assert found == {
        ("n1-standard-4", "", False): 0.19, ("n1-standard-4", "", True): 0.04,
        ("n1-standard-4", "T4", False): 0.54, ("n1-standard-4", "T4", True): 0.18,
        ("n1-standard-96", "", False): 4.56,
        ("a2-highgpu-1g", "A100", False): 3.68,
    }  # fmt: skip
