"""A sweep: a CSV file of full measurements of one application, matched with the machines of a catalog."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fogspec.base.errors import InvalidInput, UsageError
from fogspec.catalog.filters import filter_offers, matches_infra
from fogspec.catalog.instance_types import machines_of
from fogspec.catalog.table import Catalog
from fogspec.choice.rule import Rule
from fogspec.evaluation.replay import Noise
from fogspec.evaluation.suites import Problem, Setting
from fogspec.model.tables import read_table
from fogspec.numerics.kernels import Machines
from fogspec.results.ranges import LATENCY_S
from fogspec.spec.schema import Application

COLUMNS = ("instance_type", "latency_s")
FEWEST = 2


@dataclass(frozen=True)
class Sweep:
    """The problem of a sweep: its machines, the repeats over their mean, and the machines that the spec does not admit."""

    problem: Problem
    machines: Machines
    names: tuple[str, ...]
    repeats: Noise
    left_out: tuple[str, ...]


def read_sweep(path: Path, application: Application, catalog: Catalog) -> Sweep:
    """Return the sweep's machines that the spec admits; several rows of one machine are repeats, the truth their mean.

    Columns: instance_type and latency_s; infra (`aws/us-east-1`) where a type is on offer in several places, else its
    cheapest offer counts; other columns are ignored. Raise DiagnosticError for wrong rows and machines that are not in the
    catalog, InvalidInput if fewer than two admissible machines are left.
    """
    spec = application.spec
    if spec.objective.metric:
        raise UsageError(f"a sweep replays latency and cost; objective.metric is {spec.objective.metric}")
    if spec.constraints.metrics:
        limited = ", ".join(sorted(spec.constraints.metrics))
        raise UsageError(f"a sweep replays latency and cost; constraints.metrics limits {limited}")
    offers = filter_offers(catalog, spec.hardware, spec.infra).offers
    if spec.constraints.price is not None:
        offers = offers.take(offers.price_usd_per_hour <= spec.constraints.price)
    latencies: dict[int, list[float]] = {}
    left_out: dict[str, None] = {}
    table = read_table(path, COLUMNS)
    latency_s = table.numbers("latency_s", positive=True, bounds=LATENCY_S)
    table.check()
    for row, (name, infra) in enumerate(zip(table.column("instance_type"), table.column("infra"), strict=True)):
        found = _cheapest(offers, name, infra)
        if found is None:
            if _cheapest(catalog, name, infra) is None:
                place = f" in {infra}" if infra else ""
                table.problem(row, "instance_type", f"{name}{place} is not in the catalog {catalog.about.source}")
            left_out[name] = None
        else:
            latencies.setdefault(found, []).append(float(latency_s[row]))
    table.check()
    if len(latencies) < FEWEST:
        raise InvalidInput(f"{path}: the spec admits {len(latencies)} of its machines, a replay needs {FEWEST}")
    at = np.array(sorted(latencies), dtype=np.intp)
    measured = [latencies[int(row)] for row in at]
    truth = np.array([float(np.mean(one)) for one in measured])
    count = max(len(one) for one in measured)
    again = np.array([[one[i % len(one)] for one in measured] for i in range(count)]) / truth
    swept = offers.take(at)
    posed = Problem(
        id=application.metadata.name,
        kind="sweep",
        workload=application.metadata.name,
        suite="",
        rows=np.arange(len(truth)),
        latency_s=truth,
        settings=(Setting("spec", Rule.of(application, swept)),),
    )
    names = tuple(f"{swept.cloud[row]}/{swept.instance[row]}" for row in range(len(truth)))
    return Sweep(posed, machines_of(swept), names, Noise(again), tuple(left_out))


def _cheapest(offers: Catalog, name: str, infra: str) -> int | None:
    there = (offers.instance == name) & ~offers.spot
    if infra:
        there &= matches_infra(offers, infra)
    found = np.flatnonzero(there)
    return int(found[np.argmin(offers.price_usd_per_hour[found])]) if len(found) else None
