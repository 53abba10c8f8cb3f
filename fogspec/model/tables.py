"""Machines and their latencies as CSV tables: machines.csv and latencies.csv[.gz], and sweeps."""

import csv
import gzip
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.errors import InvalidInput
from fogspec.base.regular import check_file
from fogspec.numerics.features import Floats, Machines, codes

MACHINE_COLUMNS = ("Cloud", "InstanceType", "vCPUs", "MemoryGiB", "Price")
LATENCY_COLUMNS = ("workload", "suite", "cloud", "instance_type", "latency_s")


@dataclass(frozen=True)
class Table:
    """Machines by name (`cloud/type`)."""

    names: tuple[str, ...]
    machines: Machines
    row: Mapping[str, int] = field(repr=False)


@dataclass(frozen=True)
class Measured:
    """Log of nothing: latencies in seconds per workload over the rows of a table, NaN where not measured."""

    suites: dict[str, str]
    latency_s: dict[str, Floats]


def read_machines(path: Path) -> Table:
    """The machines of a suite: SkyPilot's columns and a few more; only MACHINE_COLUMNS are required."""
    listed = list(rows(path, MACHINE_COLUMNS))
    for line, row in listed:
        for name in ("vCPUs", "MemoryGiB", "Price"):
            number(path, line, row, name, required=True)
    names = tuple(f"{row['Cloud']}/{row['InstanceType']}" for _, row in listed)
    if len(set(names)) < len(names):
        twice = next(n for i, n in enumerate(names) if n in names[:i])
        raise problem(path, listed[[*names].index(twice)][0], f"{twice} is there twice")

    def column(name: str, scale: float = 1.0) -> Floats:
        return np.array([number(path, line, row, name) for line, row in listed]) * scale

    def code(name: str) -> Any:
        return codes([row.get(name, "") or "" for _, row in listed])

    count = column("AcceleratorCount")
    machines = Machines(
        vcpus=column("vCPUs"), memory_gib=column("MemoryGiB"), price_usd_per_hour=column("Price"),
        family=code("Family"), arch=code("Arch"), cloud=code("Cloud"), cpu_model=code("CpuModel"),
        gpu=code("AcceleratorName"), gpu_count=np.where(np.isnan(count), 0.0, count),
        gpu_memory_gib=column("GpuMemMiB", 1 / 1024), physical_cores=column("PhysicalCores"),
        clock_ghz=column("ClockGHz"), burstable=np.array([row.get("Burstable") in ("1", "True", "true") for _, row in listed]),
    )  # fmt: skip
    return Table(names, machines, {name: i for i, name in enumerate(names)})


def read_latencies(path: Path, table: Table) -> Measured:
    """Latencies per workload; raises `DiagnosticError` for latencies that are not positive and finite or unknown machines."""
    suites: dict[str, str] = {}
    latency: dict[str, Floats] = {}
    for line, row in rows(path, LATENCY_COLUMNS):
        name = f"{row['cloud']}/{row['instance_type']}"
        if name not in table.row:
            raise problem(path, line, f"machine {name} is not in machines.csv")
        value = number(path, line, row, "latency_s", required=True)
        workload = row["workload"]
        if suites.setdefault(workload, row["suite"]) != row["suite"]:
            raise problem(path, line, f"workload {workload} is in suite {suites[workload]} elsewhere in the file")
        if workload not in latency:
            latency[workload] = np.full(len(table.names), np.nan)
        latency[workload][table.row[name]] = value
    return Measured(suites, latency)


def found(folder: Path, name: str) -> Path:
    """The file of a suite, plain or gzipped; raises InvalidInput."""
    for candidate in (folder / name, folder / f"{name}.gz"):
        if candidate.is_file():
            return candidate
    raise InvalidInput(
        f"{folder}: no {name} or {name}.gz", "a suite is a folder of machines.csv, latencies.csv, problems.jsonl"
    )


def opened(path: Any) -> Any:
    """A file of a suite as text, plain or gzipped; raises InvalidInput for anything but a file."""
    if isinstance(path, Path):
        check_file(path)
    raw = path.open("rb")
    return io.TextIOWrapper(gzip.open(raw) if path.name.endswith(".gz") else raw, encoding="utf-8", newline="")


def rows(path: Path, required: tuple[str, ...]) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a CSV file with their line numbers; raises for missing columns and ragged rows."""
    try:
        with opened(path) as stream:
            reader = csv.DictReader(stream)
            missing = [name for name in required if name not in (reader.fieldnames or ())]
            if missing:
                raise problem(
                    path, 1, f"column {missing[0]} is missing; found {', '.join(reader.fieldnames or ['none'])}"
                )
            for row in reader:
                if None in row or None in row.values():
                    raise problem(path, reader.line_num, f"a row has {len(reader.fieldnames or ())} fields")
                yield reader.line_num, row
    except (OSError, UnicodeDecodeError, EOFError, csv.Error) as wrong:
        raise InvalidInput(f"{path}: cannot be read: {getattr(wrong, 'strerror', None) or wrong}") from None


def number(path: Path, line: int, row: dict[str, str], name: str, *, required: bool = False) -> float:
    """A field as a number, NaN where empty; one that is `required` must be positive and finite."""
    text = row.get(name) or ""
    if not text and not required:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        raise problem(path, line, f"{name} is not a number: {text!r}") from None
    if required and not (math.isfinite(value) and value > 0):
        raise problem(path, line, f"{name} must be positive and finite, got {text!r}")
    return value


def problem(path: Path, line: int, message: str) -> DiagnosticError:
    """What is wrong with a line of a suite or sweep."""
    return DiagnosticError([Diagnostic("FS402", message, Span(str(path), line, 1))])
