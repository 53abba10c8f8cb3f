"""Make the bundled catalog: `fogspec-lab snapshot [--check]`.

EC2's instance facts and offerings are moto's, on-demand Linux prices are apache-libcloud's (see `tenancy` for how
its shared-tenancy prices are recognized). Both are packages of the development environment and are read
as data, not run. What they disagree about, and what has no trustworthy price, is not a candidate: it is counted.
"""

import csv
import gzip
import io
import json
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from typing import Any

from fogspec.base.errors import InvalidInput
from fogspec.catalog.names import BUNDLED
from fogspec.catalog.sources.parse import digest
from fogspec.catalog.sources.snapshot import ABOUT, TABLE
from fogspec_lab.ec2_prices import Price, by_region, by_size

# The regions that are enabled in every AWS account (docs.aws.amazon.com/global-infrastructure).
REGIONS = (
    "ap-northeast-1", "ap-northeast-2", "ap-northeast-3", "ap-south-1", "ap-southeast-1", "ap-southeast-2",
    "ca-central-1", "eu-central-1", "eu-north-1", "eu-west-1", "eu-west-2", "eu-west-3", "sa-east-1",
    "us-east-1", "us-east-2", "us-west-1", "us-west-2",
)  # fmt: skip
COLUMNS = (
    "Cloud", "InstanceType", "AcceleratorName", "AcceleratorCount", "vCPUs", "MemoryGiB", "GpuInfo", "Price",
    "SpotPrice", "Region", "AvailabilityZone", "Arch", "Family", "PhysicalCores", "ClockGHz", "Burstable", "PriceBasis",
)  # fmt: skip
SPECIAL = ("FpgaInfo", "MediaAcceleratorInfo")
SKYPILOT_NAMES = {("A100", 81920): "A100-80GB", ("V100", 32768): "V100-32GB"}
BASES = {
    "listed": "offers at the listed price",
    "family": "offers whose listed price is not one of shared tenancy, at the price that the family's others give",
}
# Compared by hand with AWS's price list of us-east-1, which neither package has, when the packages were last upgraded.
CHECKED = (
    "in July 2026, 740 of its 741 prices in us-east-1 were unchanged, and 458 types were missing (c8i, m8a, g7e, p5, ...): "
    "see --catalog"
)

INSTALL = "pip install moto apache-libcloud"

Facts = dict[str, Any]
Key = tuple[str, str]


def main(check: bool) -> int:
    """Write the snapshot, or with `check` report whether it would change; return the exit code.

    Raise InvalidInput without the two packages.
    """
    try:
        (table, about), names = build(), _names()
    except (ModuleNotFoundError, PackageNotFoundError):
        raise InvalidInput("the snapshot is made from two packages that are not installed", INSTALL) from None
    if check:
        texts = [(ABOUT, about), (BUNDLED, names)]
        same = gzip.decompress(TABLE.read_bytes()) == table
        same = same and all(path.read_text(encoding="utf-8") == text for path, text in texts)
        print("the snapshot is what these packages give" if same else "the snapshot is not what these packages give")
        return 0 if same else 3
    TABLE.write_bytes(gzip.compress(table, 9, mtime=0))
    ABOUT.write_text(about, encoding="utf-8")
    BUNDLED.write_text(names, encoding="utf-8")
    print(f"{TABLE.name}: {TABLE.stat().st_size:,} bytes, {len(table.splitlines()) - 1:,} offers\n{about}", end="")
    return 0


def build() -> tuple[bytes, str]:
    """Return the table as CSV and its provenance as JSON; raises ModuleNotFoundError without the two packages."""
    moto, libcloud = files("moto"), files("libcloud")
    resources = moto / "ec2" / "resources"
    facts: dict[str, Facts] = _json_gz(resources / "instance_types.json.gz")
    pricing = json.loads((libcloud / "data" / "pricing.json").read_text(encoding="utf-8"))
    described = import_module("libcloud.compute.constants.ec2_instance_types").INSTANCE_TYPES
    listed = {
        (kind, region): price
        for kind, prices in pricing["compute"]["ec2_linux"].items()
        for region, price in prices.items()
        if "." in kind
    }
    offered = {
        (row["InstanceType"], region)
        for region in REGIONS
        for row in _json_gz(resources / "instance_type_offerings" / "region" / f"{region}.json.gz")
    }
    counts: Counter[str] = Counter()
    known = {kind: fact for kind, fact in facts.items() if _is_candidate(kind, fact, described.get(kind), counts)}
    prices = _prices(listed, known)
    rows = [_row(kind, region, known[kind], prices[kind, region]) for kind, region in sorted(offered & prices.keys())]
    _count(counts, offered, listed, prices, known)
    table = _csv(rows)
    dated = datetime.fromtimestamp(pricing["updated"], UTC).date().isoformat()
    return table, _about(dated, table, counts)


def _names() -> str:
    """Return as JSON every region and instance type that moto knows, so that `validate` can tell a misspelt one."""
    resources = files("moto") / "ec2" / "resources"
    regions = [one.name.partition(".")[0] for one in (resources / "instance_type_offerings" / "region").iterdir()]
    kinds = _json_gz(resources / "instance_types.json.gz")
    known = {"aws": {"regions": sorted(regions), "instances": sorted(kinds)}}
    return json.dumps(known, indent=0, ensure_ascii=False) + "\n"


def _is_candidate(kind: str, fact: Facts, described: Facts | None, counts: Counter[str]) -> bool:
    """Return whether it is a machine for SkyPilot with a shape that the packages agree on."""
    if kind.split(".")[1].startswith("metal") or not set(_arch(fact)) & {"x86_64", "arm64"}:
        counts["types left out: bare metal or macOS"] += 1
    elif any(name in fact for name in SPECIAL):
        counts["types left out: FPGA or video accelerators"] += 1
    elif described and (int(described["extra"]["vcpu"]), described["ram"]) != (_vcpus(fact), _memory_mib(fact)):
        counts["types left out: the packages disagree on vCPUs or memory"] += 1
    else:
        return True
    return False


def _prices(listed: Mapping[Key, float], known: Mapping[str, Facts]) -> dict[Key, Price]:
    with_accelerators = {kind.split(".")[0] for kind, fact in known.items() if _accelerators(fact)}
    plain = {
        key: price for key, price in listed.items() if key[0] in known and key[0].split(".")[0] not in with_accelerators
    }
    chips = {key: price for key, price in listed.items() if key[0].split(".")[0] in with_accelerators}
    return {key: price for key, price in (by_size(plain) | by_region(chips)).items() if key[0] in known}


def _count(
    counts: Counter[str],
    offered: set[Key],
    listed: Mapping[Key, float],
    prices: Mapping[Key, Price],
    known: Mapping[str, Facts],
) -> None:
    """Count the offers that moto knows by what became of them."""
    for key in offered:
        if key[0] not in known:
            continue
        if key in prices:
            counts[BASES[prices[key].basis]] += 1
        elif key not in listed:
            counts["offers left out: no price is listed"] += 1
        else:
            counts["offers left out: the listed price is 0 or not confirmed by a second one"] += 1
    absent = {key for key in listed if key[1] in REGIONS and key not in offered and listed[key] > 0}
    counts["prices left out: moto knows no such offer"] = len(absent)


def _row(kind: str, region: str, fact: Facts, price: Price) -> list[str]:
    chips = _accelerators(fact)
    name, count, memory_mib = chips[0] if chips else ("", 0, 0)
    info = {"Gpus": [{"Name": name, "Count": count, "MemoryInfo": {"SizeInMiB": memory_mib}}]} if name else ""
    clock = fact["ProcessorInfo"].get("SustainedClockSpeedInGhz")
    return [
        "aws",
        kind,
        name,
        f"{count:g}" if name else "",
        str(_vcpus(fact)),
        f"{_memory_mib(fact) / 1024:g}",
        str(info),
        f"{price.usd_per_hour:.10g}",
        "",
        region,
        "",
        _arch(fact)[-1],
        kind.split(".")[0],
        str(fact["VCpuInfo"]["DefaultCores"]),
        f"{clock:g}" if clock else "",
        str(int(fact["BurstablePerformanceSupported"])),
        price.basis,
    ]


def _accelerators(fact: Facts) -> list[tuple[str, float, int]]:
    """Return accelerators under SkyPilot's names, their number (or the fraction of one), and the memory of one in MiB."""
    found = [*fact.get("GpuInfo", {}).get("Gpus", []), *fact.get("NeuronInfo", {}).get("NeuronDevices", [])]
    chips = [
        (chip["Name"], chip["Count"] or chip["GpuPartitionSize"], chip["MemoryInfo"]["SizeInMiB"]) for chip in found
    ]
    return [(SKYPILOT_NAMES.get((name, memory), name), count, memory) for name, count, memory in chips]


def _arch(fact: Facts) -> list[str]:
    found: list[str] = fact["ProcessorInfo"]["SupportedArchitectures"]
    return found


def _vcpus(fact: Facts) -> int:
    return int(fact["VCpuInfo"]["DefaultVCpus"])


def _memory_mib(fact: Facts) -> int:
    return int(fact["MemoryInfo"]["SizeInMiB"])


def _csv(rows: list[list[str]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(rows)
    return text.getvalue().encode()


def _about(dated: str, table: bytes, counts: Counter[str]) -> str:
    about = {
        "source": "fogspec snapshot: AWS on-demand, Linux",
        "revision": f"moto {version('moto')}, apache-libcloud {version('apache-libcloud')}",
        "date": dated,
        "digest": digest(table),
        "checked": CHECKED,
        "notes": [f"{count:,} {what}" for what, count in sorted(counts.items()) if count],
    }
    return json.dumps(about, indent=2, ensure_ascii=False) + "\n"


def _json_gz(resource: Any) -> Any:
    return json.loads(gzip.decompress(resource.read_bytes()))
