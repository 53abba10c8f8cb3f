"""Reading the suite layout: machines.csv, latencies.csv[.gz], problems.jsonl[.gz]."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fogspec.evaluation.suite import KINDS, Problem, Setting, Suite
from fogspec.model.tables import Measured, Table, found, problem, read_bytes, read_latencies, read_machines


def read_suite(folder: Path) -> Suite:
    """A whole suite; raises `DiagnosticError` for wrong rows and `InvalidInput` for a missing or unreadable file."""
    table = read_machines(found(folder, "machines.csv"))
    measured = read_latencies(found(folder, "latencies.csv"), table)
    return Suite(table, tuple(read_problems(found(folder, "problems.jsonl"), table, measured)))


def read_problems(path: Path, table: Table, measured: Measured) -> Iterator[Problem]:
    """The problems, one JSON object a line."""
    for line, text in enumerate(read_bytes(path).split(b"\n"), start=1):
        if text.strip():
            yield _problem_of(path, line, text, table, measured)


def _problem_of(path: Path, line: int, text: bytes, table: Table, measured: Measured) -> Problem:
    try:
        raw = json.loads(text)
        settings = tuple(
            Setting(s["name"], float(s["alpha"]), s["max_latency_s"], s["max_cost_usd_per_request"])
            for s in raw["settings"]
        )
        kind, workload, names = raw["kind"], raw["workload"], raw["machines"]
        scale = (float(raw["scale"]["latency_s"]), float(raw["scale"]["cost_usd_per_request"]))
        identifier = raw["id"]
    except (ValueError, KeyError, TypeError) as wrong:
        raise problem(path, line, f"not a problem: {type(wrong).__name__} {wrong}") from None
    if kind not in KINDS:
        raise problem(path, line, f"kind is one of {', '.join(KINDS)}, got {kind!r}")
    if workload not in measured.latency_s:
        raise problem(path, line, f"workload {workload!r} has no latencies")
    missing = [n for n in names if n not in table.row]
    if missing or not names:
        raise problem(path, line, f"machine {missing[0]} is not in machines.csv" if missing else "no machines")
    at = np.array([table.row[n] for n in names])
    latency = measured.latency_s[workload][at]
    if np.isnan(latency).any():
        raise problem(path, line, f"{workload} was not measured on {names[int(np.flatnonzero(np.isnan(latency))[0])]}")
    if not (min(scale) > 0 and all(0 <= s.alpha <= 1 for s in settings)):
        raise problem(path, line, "scales must be positive and alpha between 0 and 1")
    return Problem(identifier, kind, workload, measured.suites[workload], at, latency, *scale, settings)
