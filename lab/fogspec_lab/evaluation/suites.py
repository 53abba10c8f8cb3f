"""Suites of selection problems: machines.csv, latencies.csv[.gz] and problems.jsonl[.gz]."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fogspec.catalog.cost import Costs
from fogspec.choice.rule import Rule, Scale, Selection
from fogspec.language.schema import Constraints
from fogspec.model.predict import Predictions
from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.prediction import Prediction
from fogspec.numerics.servers import shifts_of
from fogspec_lab.tables import Measured, Table, found, problem, read_bytes, read_latencies, read_machines

KINDS = ("family", "catalog", "multicloud", "gpu")
CONFIDENCE = Constraints().confidence  # suites do not say one


@dataclass(frozen=True, slots=True)
class Setting:
    """One question about a problem: the rule of the choice over the problem's machines."""

    name: str
    rule: Rule


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """A choice among N machines, rows of the suite's table, whose latencies (N,) under a workload are known.

    `metrics` are the metrics (N,) of the application that the settings weigh or limit.
    """

    id: str
    kind: str
    workload: str
    suite: str
    rows: np.ndarray
    latency_s: Floats
    settings: tuple[Setting, ...]
    metrics: Mapping[str, Floats] = field(default_factory=dict)

    def truth(self, rule: Rule, machines: Machines | None = None) -> Selection:
        """Return the rule applied to the true latencies and metrics.

        With the machines, the best one leaves room for other servers of its type, as the rule asks of every method.
        """
        metrics = {name: Predictions.of_values(values) for name, values in self.metrics.items()}
        latency = Predictions.of_values(self.latency_s)
        if machines is None:
            rule = replace(rule, confidence=None)
        else:
            exact = Prediction(np.log(self.latency_s), np.full(len(machines), 1e-9), *shifts_of(machines.cloud))
            latency = replace(latency, distribution=exact, type_index=np.arange(len(machines)))
        return Selection(rule=rule, latency=latency, metrics=metrics)


@dataclass(frozen=True)
class Suite:
    """Machines and problems."""

    table: Table
    problems: tuple[Problem, ...]


def read_suite(folder: Path) -> Suite:
    """Return a whole suite; raise `DiagnosticError` for wrong rows, `InvalidInput` for missing or unreadable files."""
    table = read_machines(found(folder, "machines.csv"))
    measured = read_latencies(found(folder, "latencies.csv"), table)
    return Suite(table, tuple(read_problems(found(folder, "problems.jsonl"), table, measured)))


def read_problems(path: Path, table: Table, measured: Measured) -> Iterator[Problem]:
    """Yield the problems, one JSON object a line."""
    for line, text in enumerate(read_bytes(path).split(b"\n"), start=1):
        if text.strip():
            yield _problem_of(path, line, text, table, measured)


def _problem_of(path: Path, line: int, text: bytes, table: Table, measured: Measured) -> Problem:
    try:
        raw = json.loads(text)
        scale = Scale(float(raw["scale"]["latency_s"]), float(raw["scale"]["cost_usd_per_request"]))
        settings = [
            (s["name"], float(s["alpha"]), s["max_latency_s"], s["max_cost_usd_per_request"]) for s in raw["settings"]
        ]
        kind, workload, names, identifier = raw["kind"], raw["workload"], raw["machines"], raw["id"]
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
    if not (min(scale.metric, scale.cost) > 0 and all(0 <= alpha <= 1 for _, alpha, _, _ in settings)):
        raise problem(path, line, "scales must be positive and alpha between 0 and 1")
    shared: dict[str, Any] = {
        "costs": Costs.busy(table.machines.price_usd_per_hour[at]),
        "names": np.array(names, dtype=object),
        "confidence": CONFIDENCE,
        "metric_scale": scale.metric,
        "cost_scale": scale.cost,
    }
    return Problem(
        id=identifier,
        kind=kind,
        workload=workload,
        suite=measured.suites[workload],
        rows=at,
        latency_s=latency,
        settings=tuple(
            Setting(name, Rule(alpha=alpha, max_latency_s=max_latency_s, max_cost_usd=max_cost_usd, **shared))
            for name, alpha, max_latency_s, max_cost_usd in settings
        ),
    )
