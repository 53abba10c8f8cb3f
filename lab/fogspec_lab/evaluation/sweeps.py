"""A sweep: full measurements of one application, from a CSV file or a results file, matched with the machines of a catalog."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fogspec.base.errors import InvalidInput
from fogspec.catalog.filters import matches_infra, offers_for
from fogspec.catalog.instance_types import machines_of
from fogspec.catalog.machine import Machine, TypeKey
from fogspec.catalog.table import About, Catalog, concatenated, of_machine
from fogspec.choice.rule import Rule
from fogspec.language.schema import Application
from fogspec.language.warned import sentence
from fogspec.model.fit import partition, targets
from fogspec.numerics.kernels import Floats, Machines
from fogspec.results.io import read_results_folder
from fogspec.results.ranges import LATENCY_S, METRIC
from fogspec_lab.evaluation.replay import Noise, Timing
from fogspec_lab.evaluation.suites import Problem, Setting
from fogspec_lab.recordings import COLUMNS
from fogspec_lab.tables import read_table

FEWEST = 2
USD_PER_FREE_VCPU_HOUR = 1.0

Values = dict[str, list[float]]  # of one machine, by target: a value for each repeat


@dataclass(frozen=True)
class Sweep:
    """The problem of a sweep: its machines, the repeats over their mean, and what was left out.

    `left_out` are machines that the spec does not admit, `unmeasured` those without a value. If `free`, all of them cost
    nothing, and count as `USD_PER_FREE_VCPU_HOUR` for each vCPU. `timing` is what the spec lets a sample measure.
    """

    problem: Problem
    machines: Machines
    names: tuple[str, ...]
    repeats: Noise
    left_out: tuple[str, ...]
    unmeasured: tuple[str, ...]
    free: bool
    timing: Timing

    @property
    def noise(self) -> str:
        """What a repeated sample of a machine says other than the first."""
        count = len(self.repeats.factor)
        if count == 1:
            return "none: the sweep has one measurement of each machine"
        again = int((np.ptp(self.repeats.factor, axis=0) > 0).sum())
        return f"the sweep's own: up to {count} measurements, {again} of {len(self.names)} machines repeated"


def read_sweep(path: Path, application: Application, catalog: Catalog) -> Sweep:
    """Return the sweep's machines that the spec admits; several measurements of one machine are repeats, the truth their mean.

    A CSV file has the columns instance_type and latency_s, and one for each metric in the objective and the limits; infra
    (`aws/us-east-1`) where a type is on offer in several places, else its cheapest offer counts; other columns are ignored.
    A folder has what `bench` wrote; shapes of one host are machines of their own. Raise DiagnosticError for wrong rows
    and machines that are not in the catalog, InvalidInput if fewer than two admissible machines are left.
    """
    found = _of_results(path, application, catalog) if path.is_dir() else _of_table(path, application, catalog)
    if len(found.values) < FEWEST:
        raise InvalidInput(f"{path}: the spec admits {len(found.values)} of its machines, a replay needs {FEWEST}")
    swept = found.offers.take(np.array(sorted(found.values), dtype=np.intp))
    measured = [found.values[row] for row in sorted(found.values)]
    free = not (swept.price_usd_per_hour > 0).any()
    if free:
        swept = replace(swept, price_usd_per_hour=swept.vcpus * USD_PER_FREE_VCPU_HOUR)
    truth = {name: np.array([float(np.mean(one[name])) for one in measured]) for name in targets(application)}
    again = {name: _repeats([one[name] for one in measured]) / truth[name] for name in truth}
    latency_s, factor = truth.pop("latency"), again.pop("latency")
    posed = Problem(
        id=application.metadata.name,
        kind="sweep",
        workload=application.metadata.name,
        suite="",
        rows=np.arange(len(latency_s)),
        latency_s=latency_s,
        metrics=truth,
        settings=(Setting("spec", Rule.of(application, swept)),),
    )
    names = tuple(f"{swept.cloud[row]}/{swept.instance[row]}" for row in range(len(latency_s)))
    noise, stop = Noise(factor, again), application.spec.benchmark.stop
    requests = math.inf if stop.requests is None else stop.requests
    timing = Timing(request_s=None, spread=None, requests=requests, duration_s=stop.duration)
    return Sweep(posed, machines_of(swept), names, noise, tuple(found.left_out), tuple(found.unmeasured), free, timing)


@dataclass
class _Found:
    """Values by row of the offers, and the machines that have none."""

    offers: Catalog
    values: dict[int, Values] = field(default_factory=dict)
    left_out: dict[str, None] = field(default_factory=dict)
    unmeasured: list[str] = field(default_factory=list)

    def add(self, row: int, values: Mapping[str, float]) -> None:
        mine = self.values.setdefault(row, {name: [] for name in values})
        for name, value in values.items():
            mine[name].append(value)


def _repeats(measured: Sequence[Sequence[float]]) -> Floats:
    count = max(len(one) for one in measured)
    return np.array([[one[i % len(one)] for one in measured] for i in range(count)])


def _admissible(application: Application, catalog: Catalog) -> Catalog:
    spec = application.spec
    offers = offers_for(catalog, spec).offers
    price = spec.constraints.price
    return offers if price is None else offers.take(offers.price_usd_per_hour <= price)


def _of_table(path: Path, application: Application, catalog: Catalog) -> _Found:
    found = _Found(_admissible(application, catalog))
    metrics = [name for name in targets(application) if name != "latency"]
    table = read_table(path, (*COLUMNS, *metrics))
    columns = {"latency": table.numbers("latency_s", positive=True, bounds=LATENCY_S)}
    columns |= {name: table.numbers(name, positive=True, bounds=METRIC) for name in metrics}
    table.check()
    for row, (name, infra) in enumerate(zip(table.column("instance_type"), table.column("infra"), strict=True)):
        at = _cheapest(found.offers, name, infra)
        if at is not None:
            found.add(at, {target: float(values[row]) for target, values in columns.items()})
            continue
        if _cheapest(catalog, name, infra) is None:
            place = f" in {infra}" if infra else ""
            table.problem(row, "instance_type", f"{name}{place} is not in the catalog {catalog.about.source}")
        found.left_out[name] = None
    table.check()
    return found


def _of_results(path: Path, application: Application, catalog: Catalog) -> _Found:
    results = read_results_folder(path)
    known, unusable = partition(results.spec.samples, application.spec.constraints.statistic)
    hosts: dict[TypeKey, Machine] = {one.machine.type_key: one.machine for one in known if one.machine.is_local}
    if hosts:
        found = _Found(
            concatenated([of_machine(one) for one in hosts.values()], About("shapes of one host", "", "", ""))
        )
    else:
        found = _Found(_admissible(application, catalog))
    wanted = targets(application)
    for one in known:
        machine = one.machine
        row = _same(found.offers, machine) if hosts else _cheapest(found.offers, machine.instance, machine.infra)
        if missing := [name for name in wanted if name not in one.values]:
            found.unmeasured.append(f"{machine.instance} ({', '.join(missing)})")
        elif row is None:
            found.left_out[machine.instance] = None
        else:
            found.add(row, {name: one.values[name] for name in wanted})
    found.unmeasured += [f"{one.machine.instance} ({sentence(one.why)})" for one in unusable]
    return found


def _same(offers: Catalog, machine: Machine) -> int | None:
    rows = np.flatnonzero((offers.instance == machine.instance) & offers.carries(machine))
    return int(rows[0]) if len(rows) else None


def _cheapest(offers: Catalog, name: str, infra: str) -> int | None:
    there = (offers.instance == name) & ~offers.spot
    if infra:
        there &= matches_infra(offers, infra)
    found = np.flatnonzero(there)
    return int(found[np.argmin(offers.price_usd_per_hour[found])]) if len(found) else None
