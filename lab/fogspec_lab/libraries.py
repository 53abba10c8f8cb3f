"""Build machine libraries: what other workloads take on many machines, from a suite."""

import math
from pathlib import Path

import numpy as np

from fogspec.base import digest
from fogspec.base.errors import InvalidInput
from fogspec.model.library import NUMBERS, built_in, library_bytes, read_library
from fogspec.numerics.priors import PriorData
from fogspec_lab.tables import (
    MACHINE_COLUMNS,
    Measured,
    Table,
    columns_of,
    found,
    read_latencies,
    read_machines,
    read_table,
)

DIGITS = 4  # of a log-latency: a hundredth of a per cent


def library_named(name: str | None) -> PriorData | None:
    """Return the library in a directory in the suite layout, in a file, or fogspec's own, `built-in`; None without a name."""
    if name is None:
        return None
    if name == "built-in":
        return built_in()
    return suite_library(Path(name)) if Path(name).is_dir() else read_library(Path(name))


def suite_library(folder: Path) -> PriorData:
    """Return all programs of a suite, as a library; its digest is over both files' bytes. Raise InvalidInput without any."""
    table, measured = _read(folder)
    workloads = tuple(sorted(measured.latency_s))
    return PriorData(
        names=table.names,
        machines=table.machines,
        workloads=workloads,
        suites=tuple(measured.suites[one] for one in workloads),
        log_latency=np.log(np.array([measured.latency_s[one] for one in workloads])),
        digest=digest.of_value(
            [digest.of_bytes(found(folder, name).read_bytes()) for name in ("machines.csv", "latencies.csv")]
        ),
    )


def library_file(folder: Path) -> bytes:
    """Return the JSON of the library of a suite: of each program, how many times as long each machine takes as all do."""
    _, measured = _read(folder)
    table = read_table(found(folder, "machines.csv"), MACHINE_COLUMNS)
    texts, numbers = columns_of(table)
    programs = []
    for name in sorted(measured.latency_s):
        profile = np.log(measured.latency_s[name])
        programs.append((name, measured.suites[name], _rounded(profile - np.nanmean(profile), DIGITS)))
    return library_bytes(
        [*table.column("InstanceType")],
        texts,
        {name: _rounded(numbers[name], 6) for name in NUMBERS},
        programs,
    )


def _read(folder: Path) -> tuple[Table, Measured]:
    table = read_machines(found(folder, "machines.csv"))
    measured = read_latencies(found(folder, "latencies.csv"), table)
    if not measured.latency_s:
        raise InvalidInput(f"{folder}: no workload was measured on any machine")
    return table, measured


def _rounded(column: np.ndarray, digits: int) -> list[float | None]:
    return [None if math.isnan(value) else round(value, digits) for value in column.tolist()]
