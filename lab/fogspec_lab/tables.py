"""Machines and their latencies as CSV tables: machines.csv and latencies.csv[.gz], and sweeps."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fogspec.base.csv_table import MOST_BYTES, CsvTable, parse_csv
from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.errors import InvalidInput
from fogspec.base.files import decompress, read_bounded
from fogspec.catalog.classes import cpu_kind
from fogspec.model.library import machines_of
from fogspec.numerics.kernels import Floats, Machines
from fogspec.results.ranges import LATENCY_S

MACHINE_COLUMNS = ("Cloud", "InstanceType", "vCPUs", "MemoryGiB", "Price")
MOST_VALUES = 10_000_000
LATENCY_COLUMNS = ("workload", "suite", "cloud", "instance_type", "latency_s")


@dataclass(frozen=True)
class Table:
    """Machines by name (`cloud/type`)."""

    names: tuple[str, ...]
    machines: Machines
    row: Mapping[str, int] = field(repr=False)


@dataclass(frozen=True)
class Measured:
    """Latencies in seconds by workload over the rows of a table, NaN where not measured; the suite of each workload."""

    suites: dict[str, str]
    latency_s: dict[str, Floats]


def read_machines(path: Path) -> Table:
    """Return the machines of a suite: SkyPilot's columns and a few more; only MACHINE_COLUMNS are required."""
    table = read_table(path, MACHINE_COLUMNS)
    names = tuple(
        f"{cloud}/{kind}" for cloud, kind in zip(table.column("Cloud"), table.column("InstanceType"), strict=True)
    )
    row: dict[str, int] = {}
    for i, name in enumerate(names):
        if row.setdefault(name, i) != i:
            table.problem(row[name], "InstanceType", f"{name} is there twice")

    texts, numbers = columns_of(table)
    table.check()
    return Table(names, machines_of(texts, numbers), row)


def columns_of(table: CsvTable) -> tuple[dict[str, list[str]], dict[str, Floats]]:
    """Return the columns of machines by the names of `Machines`: texts, and numbers."""
    texts = {"cloud": "Cloud", "family": "Family", "arch": "Arch", "gpu": "AcceleratorName"}
    vcpus, memory_gib, price = (table.numbers(name, positive=True) for name in ("vCPUs", "MemoryGiB", "Price"))
    numbers = {
        "vcpus": vcpus,
        "memory_gib": memory_gib,
        "price_usd_per_hour": price,
        "gpu_count": table.numbers("AcceleratorCount"),
        "gpu_memory_gib": table.numbers("GpuMemMiB") / 1024,
        "physical_cores": table.numbers("PhysicalCores"),
        "clock_ghz": table.numbers("ClockGHz"),
        "burstable": np.array([float(text in ("1", "True", "true")) for text in table.column("Burstable")]),
    }
    return {name: [*table.column(column)] for name, column in texts.items()} | {"cpu_model": _cpus(table)}, numbers


def _cpus(table: CsvTable) -> list[str]:
    """Return the name of each machine's CPU; of a cloud without any name or clock, what the family tells (ADR 0020)."""
    columns = [table.column(name) for name in ("CpuModel", "Cloud", "Arch", "Family")]
    clocks = table.column("ClockGHz")
    named = {cloud for name, cloud, clock in zip(columns[0], columns[1], clocks, strict=True) if name or clock}
    return [
        name or ("" if cloud in named else cpu_kind(cloud, arch, family))
        for name, cloud, arch, family in zip(*columns, strict=True)
    ]


def read_latencies(path: Path, table: Table) -> Measured:
    """Latencies per workload; raises `DiagnosticError` for latencies that are not positive and finite or unknown machines."""
    suites: dict[str, str] = {}
    latency: dict[str, Floats] = {}
    file = read_table(path, LATENCY_COLUMNS)
    values = file.numbers("latency_s", positive=True, bounds=LATENCY_S)
    texts = zip(*(file.column(name) for name in LATENCY_COLUMNS[:4]), strict=True)
    for row, (workload, suite, cloud, kind) in enumerate(texts):
        name = f"{cloud}/{kind}"
        if name not in table.row:
            file.problem(row, "instance_type", f"machine {name} is not in machines.csv")
            continue
        if suites.setdefault(workload, suite) != suite:
            file.problem(row, "suite", f"workload {workload} is in suite {suites[workload]} elsewhere in the file")
            suites[workload] = suite
        if workload not in latency:
            if (len(latency) + 1) * len(table.names) > MOST_VALUES:
                file.problem(row, "workload", f"workloads times machines are at most {MOST_VALUES:,}")
                break
            latency[workload] = np.full(len(table.names), np.nan)
        latency[workload][table.row[name]] = values[row]
    file.check()
    return Measured(suites, latency)


def found(folder: Path, name: str) -> Path:
    """Return the path of a suite's file, plain or gzipped; raise InvalidInput if there is none."""
    for candidate in (folder / name, folder / f"{name}.gz"):
        if candidate.is_file():
            return candidate
    raise InvalidInput(
        f"{folder}: no {name} or {name}.gz", "a suite is a folder of machines.csv, latencies.csv, problems.jsonl"
    )


def read_table(path: Path, required: Sequence[str]) -> CsvTable:
    """Return a CSV file of a suite or sweep, plain or gzipped; raise InvalidInput, and DiagnosticError for a wrong table."""
    return parse_csv(read_bytes(path), str(path), required, code="FS402", what=path.name)


def read_bytes(path: Path) -> bytes:
    """Return the content of a file, plain or gzipped; raise InvalidInput if it is not a file."""
    try:
        return decompress(read_bounded(path, MOST_BYTES), str(path), MOST_BYTES)
    except (OSError, EOFError, zlib.error) as wrong:
        raise InvalidInput(f"{path}: cannot be read: {getattr(wrong, 'strerror', None) or wrong}") from None


def problem(path: Path, line: int, message: str) -> DiagnosticError:
    """Return the error for a line of a suite or sweep."""
    return DiagnosticError([Diagnostic("FS402", message, Span(str(path), line, 1))])
