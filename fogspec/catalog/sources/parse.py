"""Catalog tables in SkyPilot's columns, read into a `Catalog`: one row per offering, prices in USD per hour.

Columns of SkyPilot's catalog schema v8: InstanceType, AcceleratorName, AcceleratorCount, vCPUs, MemoryGiB, GpuInfo,
Price, SpotPrice, Region, AvailabilityZone, Arch. Also read: Cloud, Family, PhysicalCores, ClockGHz,
Burstable, GpuMemMiB. Other columns are ignored. A table of one's own machines may be without the column Price: an hour of a
machine then costs its vCPUs, in core-hours.
"""

import gc
import math
import re
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fogspec.base.clouds import cloud_of
from fogspec.base.csv_table import CsvTable, parse_csv
from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.digest import of_bytes
from fogspec.catalog.sources import gcp
from fogspec.catalog.table import About, Catalog, Floats, Strings, strings

LEAST_MIB = 512  # of an accelerator
MOST_VCPUS = 2000  # in one machine
REQUIRED = ("InstanceType", "vCPUs", "MemoryGiB", "Region")
CORE_HOURS = "no column Price: costs are core-hours (core-h), and $1 in a spec stands for one"
GPU_MIB = re.compile(r"SizeInMiB\D{1,20}(\d{1,9})")
TRUE = ("1", "1.0", "true", "True")
ARCHITECTURES = {"aarch64": "arm64", "arm": "arm64", "amd64": "x86_64", "x64": "x86_64", "i386": "x86_64"}


def read(content: bytes, path: str, cloud: str | None, about: About) -> Catalog:
    """Return the offers of one CSV file; `cloud` is the cloud of rows without a column `Cloud`.

    Raises DiagnosticError for a wrong table, with every wrong field. Rows without a price, with a price of 0 or without
    a shape are not candidates: they are counted in `about.notes`, with the line of the first one, as are repeated
    rows, of which the highest price counts.
    """
    collecting = gc.isenabled()
    gc.disable()  # a row is many objects, none of them garbage: collecting would take a third of the time
    try:
        return _read(content, path, cloud, about)
    finally:
        if collecting:
            gc.enable()


def _read(content: bytes, path: str, cloud: str | None, about: About) -> Catalog:
    rows = parse_csv(content, path, REQUIRED, code="FS401", what="a catalog")
    if cloud is None and "Cloud" not in rows.columns:
        message = "which cloud these machines belong to must be said: a column Cloud is missing"
        raise DiagnosticError([Diagnostic("FS401", message, Span(path, 1, 1))])
    machines, spot = _machines(rows, cloud or "", about), rows.numbers("SpotPrice")
    rows.check()
    notes, core_hours = [*about.notes], "Price" not in rows.columns
    if core_hours:
        _check_core_hours(rows, machines)
        machines = replace(machines, price_usd_per_hour=machines.vcpus)
        notes.append(f"{path}: {CORE_HOURS}")
    notes += [*_implausible(rows, machines), *_left_out(rows, machines, spot)]
    offers = _priced(*gcp.joined(_unpriced(machines), spot))
    once = offers.merged()
    if repeated := len(offers) - len(once):
        are = "offer is" if repeated == 1 else "offers are"
        notes.append(f"{path}: {repeated:,} {are} repeated: the highest price of each counts")
        other = (np.diff(offers.vcpus, prepend=0) != 0) | (np.diff(offers.memory_gib, prepend=0) != 0)
        if (rows_of := np.flatnonzero(offers.repeated() & other)).size:
            name = offers.instance[rows_of[0]]
            notes.append(
                f"warning: {path}: {name} has two sizes: the size of the cheaper row counts, at one price the smaller"
            )
    found = replace(about, digest=digest(content), notes=tuple(notes), core_hours=core_hours)
    return replace(once, about=found)


def _check_core_hours(rows: CsvTable, machines: Catalog) -> None:
    """Raise DiagnosticError unless every machine is one's own, and the column Price is left out and not misspelled."""
    misspelled = sorted(name for name in rows.columns if "price" in name.lower() or "cost" in name.lower())
    rented = sorted({cloud for cloud in set(machines.cloud) if cloud_of(cloud).priced})
    if misspelled or rented:
        instead = f"it has {misspelled[0]}" if misspelled else f"machines of {rented[0]} have prices"
        message = f"a catalog needs the column Price, in USD per hour: {instead}"
        raise DiagnosticError([Diagnostic("FS401", message, Span(rows.path, 1, 1))])


def digest(content: bytes) -> str:
    """Return the sha256 of the header and the sorted lines, whatever the order of the rows."""
    head, *rest = content.replace(b"\r\n", b"\n").split(b"\n")
    return of_bytes(b"\n".join([head, *sorted(filter(None, rest))]))


def _machines(rows: CsvTable, cloud: str, about: About) -> Catalog:
    """Return one row per line of the table, priced or not."""
    clouds = _clouds(rows, cloud)
    instances = rows.shared("InstanceType")
    return Catalog(
        about=about,
        cloud=clouds,
        region=rows.shared("Region"),
        zone=rows.shared("AvailabilityZone"),
        instance=instances,
        vcpus=rows.numbers("vCPUs"),
        memory_gib=rows.numbers("MemoryGiB"),
        gpu=rows.shared("AcceleratorName"),
        gpu_count=np.nan_to_num(rows.numbers("AcceleratorCount")),
        gpu_memory_gib=_gpu_memory_gib(rows),
        price_usd_per_hour=rows.numbers("Price"),
        spot=np.zeros(rows.size, dtype=np.bool_),
        arch=strings(map(arch_of, clouds, instances, rows.column("Arch"))),
        family=strings(map(family_of, clouds, instances, rows.column("Family"))),
        physical_cores=rows.numbers("PhysicalCores"),
        clock_ghz=rows.numbers("ClockGHz"),
        burstable=np.fromiter(map(TRUE.__contains__, rows.column("Burstable")), np.bool_, rows.size),
    )


def _clouds(rows: CsvTable, cloud: str) -> Strings:
    column = rows.column("Cloud")
    known = {text: text.strip().lower() or cloud for text in set(column)}
    return strings(map(known.__getitem__, column))


@cache
def arch_of(cloud: str, instance: str, given: str) -> str:
    """Return `x86_64` or `arm64`, from the column of the table, else from the name; other words are kept."""
    if word := given.strip().lower():
        return ARCHITECTURES.get(word, word)
    pattern = cloud_of(cloud).arm
    arm = pattern is not None and re.match(pattern, instance)
    return "arm64" if arm else "x86_64"


@cache
def family_of(cloud: str, instance: str, given: str) -> str:
    """Return the family: `c6i` of c6i.large, `n2` of n2-standard-4, `Dsv5` of Standard_D8s_v5; else the first word."""
    if given:
        return given
    pattern = cloud_of(cloud).family
    if pattern is not None and (match := re.match(pattern, instance)):
        return "".join(part or "" for part in match.groups())
    return re.split(r"[.\-_]", instance, maxsplit=1)[0]


def _gpu_memory_gib(rows: CsvTable) -> Floats:
    """Return the memory of one accelerator in GiB: from GpuMemMiB, else from SkyPilot's GpuInfo.

    SkyPilot's lists of RunPod and Shadeform have GiB there, under the same name.
    """
    if "GpuMemMiB" in rows.columns:
        return rows.numbers("GpuMemMiB") / 1024
    column = rows.column("GpuInfo")
    found = {text: GPU_MIB.search(text) for text in set(column)}
    sizes = {text: float(match[1]) if match else math.nan for text, match in found.items()}
    known = {text: size / 1024 if size >= LEAST_MIB else size for text, size in sizes.items()}
    return np.fromiter(map(known.__getitem__, column), np.float64, len(column))


def _left_out(rows: CsvTable, machines: Catalog, spot: Floats) -> Iterator[str]:
    """Yield a note for each reason why rows are not candidates, with the line of the first such row."""
    price = machines.price_usd_per_hour
    for mask, reason in (
        (np.isnan(price) & ~(spot > 0), "no price: not a candidate"),
        (price == 0, "a price of 0: not a candidate"),
        (spot == 0, "a spot price of 0: not a spot candidate"),
        (~(machines.vcpus > 0) | ~(machines.memory_gib > 0), "no vCPUs or no memory: not a candidate"),
        ((machines.gpu != "") & (machines.gpu_count == 0), "an accelerator without a count: not a candidate"),
    ):
        found = np.flatnonzero(mask & (machines.instance != "")).tolist()
        if found:
            have = "row has" if len(found) == 1 else "rows have"
            first = f"{machines.instance[found[0]]} at line {rows.lines[found[0]]}"
            yield f"{rows.path}: {len(found):,} {have} {reason}, such as {first}"


def _implausible(rows: CsvTable, machines: Catalog) -> Iterator[str]:
    """Yield a warning for each column with sizes that no machine has, with the line of the first and the likely unit.

    The lists of AWS, Azure and Google Cloud have 0.25 to 37 GiB per vCPU and up to 1,920 vCPUs, an accelerator has 1 to 288
    GiB, and a vCPU costs 1/31 to 26 times what it costs at the median (July 2026).
    """
    vcpus, gpu_gib = machines.vcpus, machines.gpu_memory_gib
    cpus = np.where((vcpus > 0) & (vcpus < MOST_VCPUS), vcpus, np.nan)
    gib_per_vcpu, usd_per_vcpu = machines.memory_gib / cpus, machines.price_usd_per_hour / cpus
    paid = usd_per_vcpu[usd_per_vcpu > 0]
    of_median = usd_per_vcpu / (np.median(paid) if paid.size else np.nan)
    gpu = "GpuMemMiB" if "GpuMemMiB" in rows.columns else "GpuInfo"
    for mask, column, says, unit in (
        (vcpus >= MOST_VCPUS, "vCPUs", "{:,.4g} vCPUs", "thousandths of one"),
        (gib_per_vcpu > 128, "MemoryGiB", "{1:,.4g} GiB per vCPU", "MB"),
        (_below(gib_per_vcpu, 0.02), "MemoryGiB", "{1:,.4g} GiB per vCPU", "TB"),
        (gpu_gib > 4096, gpu, "{2:,.4g} GiB per accelerator", "KiB"),
        (_below(gpu_gib, LEAST_MIB / 1024), gpu, "{2:,.4g} GiB per accelerator", "GiB"),
        (of_median > 100, "Price", "{3:,.4g} times the median price per vCPU", "cents, or USD per month"),
        (_below(of_median, 0.01), "Price", "{3:.2g} times the median price per vCPU", "USD per minute or second"),
    ):
        if (found := np.flatnonzero(mask)).size:
            row = int(found[0])
            value = says.format(vcpus[row], gib_per_vcpu[row], gpu_gib[row], of_median[row])
            beside = f", as in {len(found):,} rows" if len(found) > 1 else ""
            yield f"warning: {rows.path}:{rows.lines[row]}: {column} makes it {value}{beside}: is it in {unit}?"


def _below(values: Floats, least: float) -> NDArray[np.bool_]:
    return np.asarray((values > 0) & (values < least), dtype=np.bool_)


def _unpriced(machines: Catalog) -> Catalog:
    """Return the machines with NaN for a price of 0, before an accelerator's price is added to it."""
    price = machines.price_usd_per_hour
    return replace(machines, price_usd_per_hour=np.where(price > 0, price, np.nan))


def _priced(machines: Catalog, spot: Floats) -> Catalog:
    """Return on-demand and spot offers as separate rows, in order, without rows that lack a name, shape or price."""
    order = machines.order()
    machines, spot = machines.take(order), spot[order]
    whole = (machines.instance != "") & (machines.vcpus > 0) & (machines.memory_gib > 0)
    whole &= (machines.gpu == "") | (machines.gpu_count > 0)
    on_demand = machines.take(whole & (machines.price_usd_per_hour > 0))
    rows = whole & (spot > 0)
    if not rows.any():
        return on_demand
    spots = machines.take(rows)
    spots = replace(spots, price_usd_per_hour=spot[rows], spot=np.ones(len(spots), dtype=np.bool_))
    names = [f.name for f in fields(Catalog) if f.name != "about"]
    both = {name: np.concatenate([getattr(on_demand, name), getattr(spots, name)]) for name in names}
    return Catalog(about=machines.about, **both)
