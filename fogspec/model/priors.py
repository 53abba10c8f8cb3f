"""Performance priors: libraries of what machines do elsewhere, read, written, and built from Spare Cores' data.

A library is a folder in the suite layout, or a zip archive of one. Spare Cores' measurements come from the SQLite database that
the `sparecores-data` package keeps at the user's site (module `sc_data`); its tables are those of sc-crawler
(github.com/SpareCores/sc-crawler, table_bases.py): server, server_price, benchmark and benchmark_score. The data are
CC BY-SA 4.0 (sparecores.com).
"""

import csv
import importlib
import io
import json
import sqlite3
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from fogspec.base import digest
from fogspec.base.errors import CloudError, InvalidInput, OutOfDate
from fogspec.base.layout import Layout
from fogspec.base.project_files import write_output
from fogspec.base.text import shell_command
from fogspec.model.tables import LATENCY_COLUMNS, MACHINE_COLUMNS, found, read_latencies, read_machines, read_table
from fogspec.numerics.priors import PriorData
from fogspec.spec.lockfile import Pins

EPOCH = (1980, 1, 1, 0, 0, 0)  # archives of the same data have the same bytes
INSTALL = "python -m pip install sparecores-data"
CLOUDS = ("aws", "azure", "gcp")
FEWEST_MACHINES = 10  # a benchmark of fewer says nothing about a choice among them
SERVERS = """
    SELECT s.vendor_id AS cloud, s.server_id, s.api_reference, s.family, s.vcpus, s.cpu_cores, s.cpu_speed,
           s.cpu_architecture, s.cpu_manufacturer, s.cpu_model, s.cpu_allocation, s.memory_amount, s.gpu_count,
           s.gpu_memory_min, s.gpu_model, MIN(p.price) AS price
    FROM server s JOIN server_price p ON p.vendor_id = s.vendor_id AND p.server_id = s.server_id
    WHERE p.allocation IN ('ONDEMAND', 'ondemand') AND p.unit IN ('HOUR', 'hour') AND p.currency = 'USD' AND p.price > 0
          AND s.vcpus > 0 AND s.memory_amount > 0 AND s.vendor_id IN ({})
    GROUP BY s.vendor_id, s.server_id ORDER BY s.vendor_id, s.api_reference
"""
SCORES = """
    SELECT b.framework, b.benchmark_id, b.higher_is_better, c.config, c.vendor_id AS cloud, c.server_id, c.score
    FROM benchmark_score c JOIN benchmark b ON b.benchmark_id = c.benchmark_id
    WHERE c.score > 0 ORDER BY b.benchmark_id, c.config, c.vendor_id, c.server_id
"""
MACHINE = (
    "Cloud", "InstanceType", "AcceleratorName", "AcceleratorCount", "vCPUs", "MemoryGiB", "Price", "Family", "Arch",
    "CpuModel", "CpuManufacturer", "PhysicalCores", "ClockGHz", "Burstable", "GpuMemMiB",
)  # fmt: skip

Row = dict[str, Any]


def read_priors(path: Path) -> PriorData:
    """Return a library; its digest is over both files' bytes. Raise InvalidInput and DiagnosticError."""
    folder = _opened(path)
    machines, latencies = found(folder, "machines.csv"), found(folder, "latencies.csv")
    table = read_machines(machines)
    measured = read_latencies(latencies, table)
    workloads = tuple(sorted(measured.latency_s))
    if not workloads:
        raise InvalidInput(f"{path}: no workload was measured on any machine")
    return PriorData(
        names=table.names,
        machines=table.machines,
        workloads=workloads,
        suites=tuple(measured.suites[w] for w in workloads),
        log_latency=np.log(np.array([measured.latency_s[w] for w in workloads])),
        digest=digest.of_value([digest.of_bytes(machines.read_bytes()), digest.of_bytes(latencies.read_bytes())]),
    )


def locked_priors(layout: Layout, pins: Pins | None) -> PriorData | None:
    """Return the machine library that the lock pins, None without one; raise OutOfDate if its digest changed."""
    if pins is None or pins.priors is None:
        return None
    path = layout.root / pins.priors.origin
    library = read_priors(path)
    if library.digest != pins.priors.digest:
        raise OutOfDate(
            f"{layout.name}: the machine library {path} is not the one that {layout.lock} pins",
            shell_command("fogspec", "lock", layout.spec, "--priors", path),
        )
    return library


def write_priors(path: Path, machines: Sequence[dict[str, Any]], latencies: Sequence[dict[str, Any]]) -> None:
    """Write the rows of both files as a reproducible zip archive; raise InvalidInput without rows."""
    if not machines or not latencies:
        raise InvalidInput("there is nothing to put into a library: no machine was measured")
    files = {"machines.csv": _csv(machines, list(machines[0])), "latencies.csv": _csv(latencies, LATENCY_COLUMNS)}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)
    write_output(path, packed.getvalue())


def rows_of(path: Path) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Rows of both files of a folder in the suite layout, checked."""
    read_priors(path)
    folder = _opened(path)
    machines = read_table(found(folder, "machines.csv"), MACHINE_COLUMNS)
    return machines.records(), read_table(found(folder, "latencies.csv"), LATENCY_COLUMNS).records()


def _opened(path: Path) -> Any:
    """Return a directory, or the root of an archive."""
    if not path.is_file():
        return path
    try:
        return zipfile.Path(path)
    except (zipfile.BadZipFile, OSError) as wrong:
        raise InvalidInput(f"{path}: not a library: {wrong}", "fogspec priors build --out FILE.zip") from None


def _csv(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> str:
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, list(columns), lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def sparecores_database() -> Path:
    """Return the path of the database of `sparecores-data`, which may download it; raise InvalidInput or CloudError."""
    try:
        package = importlib.import_module("sc_data")
    except ModuleNotFoundError:
        raise InvalidInput("sparecores-data is not installed here", INSTALL) from None
    except Exception as failed:
        raise CloudError(f"sparecores-data could not fetch its data: {failed}") from None
    return Path(package.db.path)


def read_sparecores(path: Path) -> tuple[list[Row], list[Row]]:
    """Rows of machines.csv and of latencies.csv; raises InvalidInput for a database with other tables."""
    if not path.is_file():
        raise InvalidInput(f"{path}: no such file")
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
            connection.row_factory = sqlite3.Row
            servers = list(connection.execute(SERVERS.format(", ".join("?" * len(CLOUDS))), CLOUDS))
            names = {(row["cloud"], row["server_id"]): row["api_reference"] for row in servers}
            return [_machine(row) for row in servers], list(_latencies(connection, names))
    except sqlite3.Error as wrong:
        raise InvalidInput(f"{path}: not a database of sparecores-data: {wrong}") from None


def _machine(row: sqlite3.Row) -> Row:
    count = float(row["gpu_count"] or 0)
    values = (
        row["cloud"],
        row["api_reference"],
        (row["gpu_model"] or "GPU") if count else "",
        count or "",
        row["vcpus"],
        row["memory_amount"] / 1024,
        row["price"],
        row["family"] or "",
        str(row["cpu_architecture"] or "").lower(),
        row["cpu_model"] or "",
        row["cpu_manufacturer"] or "",
        row["cpu_cores"] or "",
        row["cpu_speed"] or "",
        int(str(row["cpu_allocation"]).lower() == "burstable"),
        row["gpu_memory_min"] if count else "",
    )
    return dict(zip(MACHINE, values, strict=True))


def _latencies(connection: sqlite3.Connection, names: dict[tuple[str, str], str]) -> Iterator[Row]:
    """Scores as seconds per unit of work: of those where higher is better the inverse."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in connection.execute(SCORES):
        name = names.get((row["cloud"], row["server_id"]))
        if name is not None:
            workload = row["benchmark_id"] + _suffix(row["config"])
            latency = 1 / row["score"] if row["higher_is_better"] else row["score"]
            line = {"workload": workload, "suite": row["framework"], "cloud": row["cloud"], "instance_type": name}
            found.setdefault((row["framework"], workload), []).append({**line, "latency_s": repr(float(latency))})
    for _, lines in sorted(found.items()):
        if len(lines) >= FEWEST_MACHINES:
            yield from lines


def _suffix(config: str | None) -> str:
    values = json.loads(config or "{}")
    return "".join(f" {key}={values[key]}" for key in sorted(values))
