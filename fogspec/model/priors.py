"""A library of what machines do elsewhere: a folder in the suite layout, or a zip archive of one."""

import csv
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fogspec.base import digest
from fogspec.base.errors import InvalidInput, OutOfDate
from fogspec.base.files import write_bytes
from fogspec.base.layout import Layout
from fogspec.model.tables import LATENCY_COLUMNS, MACHINE_COLUMNS, found, read_latencies, read_machines, read_table
from fogspec.numerics.priors import Library
from fogspec.spec.lockfile import Pins

EPOCH = (1980, 1, 1, 0, 0, 0)  # archives of the same data have the same bytes


def read_priors(path: Path) -> Library:
    """Machines and latencies; the digest is over both files' bytes. Raises InvalidInput and DiagnosticError."""
    folder = _opened(path)
    machines, latencies = found(folder, "machines.csv"), found(folder, "latencies.csv")
    table = read_machines(machines)
    measured = read_latencies(latencies, table)
    workloads = tuple(sorted(measured.latency_s))
    if not workloads:
        raise InvalidInput(f"{path}: no workload was measured on any machine")
    return Library(
        names=table.names,
        machines=table.machines,
        workloads=workloads,
        suites=tuple(measured.suites[w] for w in workloads),
        log_latency=np.log(np.array([measured.latency_s[w] for w in workloads])),
        digest=digest.of_value([digest.of_bytes(machines.read_bytes()), digest.of_bytes(latencies.read_bytes())]),
    )


def locked_priors(layout: Layout, pins: Pins | None) -> Library | None:
    """The machine library that the lock names, None where it names none; raises OutOfDate when it is another one by now."""
    if pins is None or pins.priors is None:
        return None
    path = layout.root / pins.priors.origin
    library = read_priors(path)
    if library.digest != pins.priors.digest:
        raise OutOfDate(
            f"{layout.name}: the machine library {path} is not the one that {layout.lock} pins",
            f"fogspec lock {layout.spec} --priors {path}",
        )
    return library


def write_priors(path: Path, machines: Sequence[dict[str, Any]], latencies: Sequence[dict[str, Any]]) -> None:
    """The rows of both files as a zip archive, the same bytes for the same rows; raises InvalidInput for none."""
    if not machines or not latencies:
        raise InvalidInput("there is nothing to put into a library: no machine was measured")
    files = {"machines.csv": _csv(machines, list(machines[0])), "latencies.csv": _csv(latencies, LATENCY_COLUMNS)}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)
    write_bytes(path, packed.getvalue())


def rows_of(path: Path) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Rows of both files of a folder in the suite layout, checked."""
    read_priors(path)
    folder = _opened(path)
    machines = read_table(found(folder, "machines.csv"), MACHINE_COLUMNS)
    return machines.records(), read_table(found(folder, "latencies.csv"), LATENCY_COLUMNS).records()


def _opened(path: Path) -> Any:
    """A folder, or the root of an archive."""
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
