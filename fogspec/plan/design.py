"""Which machines are measured, and why: the grid of section 2.A per infra and GPU type, or an explicit list."""

import difflib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fogspec.base import units
from fogspec.base.clouds import LOCAL, cloud_name, cloud_of
from fogspec.base.errors import Infeasible, InvalidInput
from fogspec.catalog.filters import Filtered, before_empty, gpu_type, matches_gpu, matches_infra, merge_zones
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog, Floats, ranks
from fogspec.numerics.design import Cell, Grid, edge_grid
from fogspec.spec.schema import Spec, local_shape

if TYPE_CHECKING:
    from fogspec.numerics.priors import Library


@dataclass(frozen=True, slots=True)
class DesignPoint:
    """A machine to measure, and why."""

    machine: Machine
    reason: str

    @property
    def id(self) -> str:
        """Names the sample everywhere; it depends on the machine alone, so that a wider plan keeps it."""
        return sample_id(self.machine)


@dataclass(frozen=True, slots=True)
class Design:
    """The machines, and what people should know of how they were found."""

    picks: tuple[DesignPoint, ...]
    notes: tuple[str, ...]


def sample_id(machine: Machine, nth: int = 1) -> str:
    """The id of a machine's sample, or of the `nth` one of the same machine."""
    words = [machine.infra, machine.instance]
    if machine.gpu and cloud_of(machine.infra).attaches_gpus:
        words.append(machine.gpu.key)  # one host, several accelerators
    if machine.spot:
        words.append("spot")
    if nth > 1:
        words.append(f"repeat-{nth}")
    return re.sub(r"[^a-z0-9]+", "-", " ".join(words).lower()).strip("-")


def replicate(sample_id: str) -> int:
    """Which sample of its machine this is: 1 for the first."""
    found = re.search(r"-repeat-([0-9]+)$", sample_id)
    return int(found[1]) if found else 1


def design(spec: Spec, catalog: Catalog, admissible: Filtered, library: "Library | None" = None) -> Design:
    """The sampler's machines, an adaptive one's with what the library knows of them.

    Raises Infeasible when there are none, InvalidInput for an unknown instance type.
    """
    named = spec.benchmark.machines
    found = (
        _listed(spec, catalog, admissible) if named
        else _adaptive(spec, admissible, library) if spec.benchmark.sampler == "adaptive"
        else _grid(spec, admissible)
    )  # fmt: skip
    if not found.picks:
        instead = before_empty(catalog, spec.hardware, spec.infra)
        hints = [admissible.funnel.line(), *_unknown_places(spec.infra, catalog), *([instead] if instead else [])]
        raise Infeasible("no machine on offer is admissible", *hints)
    return _distinct(found)


def cheapest_first(offers: Catalog) -> NDArray[np.intp]:
    """Row numbers by price, then by instance, region and zone."""
    names = (offers.gpu, offers.zone, offers.region, offers.cloud, offers.instance)
    return np.lexsort((offers.spot, *(ranks(name) for name in names), offers.price_usd_per_hour))


def max_cost_usd(spec: Spec, price_usd_per_hour: Floats) -> Floats:
    """What one sample of each machine may cost: set-up and measuring, for as long as the spec allows."""
    return price_usd_per_hour * (spec.benchmark.setup_timeout + spec.benchmark.stop.duration) / 3600


def _adaptive(spec: Spec, admissible: Filtered, library: "Library | None") -> Design:
    """The first wave; the next ones are asked for when it is measured (`fogspec.choice.next_samples`)."""
    from fogspec.numerics.acquisition import Policy
    from fogspec.plan.initial_batch import initial_batch

    offers, budget = admissible.offers, spec.benchmark.budget
    if not len(offers):
        return Design((), ())
    usd = max_cost_usd(spec, offers.price_usd_per_hour)
    asked = initial_batch(offers, usd, math.inf if budget is None else max(budget, float(usd.min())), library)
    picks = tuple(DesignPoint(offers.machine(row), why) for row, why in zip(asked.rows, asked.reasons, strict=True))
    at_once = "one by one" if spec.benchmark.batch_size == 1 else f"{spec.benchmark.batch_size} at once"
    wall = None if budget is None else units.format_money(budget)
    most = f"{Policy().most} samples: there is no budget" if wall is None else f"the budget of {wall}"
    later = f"the first wave; then the model is asked for the next machines, {at_once}, never beyond {most}"
    return Design(picks, (later,))


def _grid(spec: Spec, admissible: Filtered) -> Design:
    picks: list[DesignPoint] = []
    notes: list[str] = []
    offers = admissible.offers
    for entry in spec.infra:
        here = matches_infra(offers, entry)
        for gpu in spec.hardware.gpus:
            group = offers.take(here & matches_gpu(offers, gpu))
            if not len(group):
                notes.append(f"{entry}, GPU {gpu}: no admissible machine, nothing is sampled")
                continue
            grid = edge_grid(group.vcpus, group.memory_gib, cheapest_first(group))
            picks += [
                DesignPoint(group.machine(cell.row), _reason(cell, gpu)) for cell in grid.cells if cell.same_as is None
            ]
            notes += [f"{entry}, GPU {gpu}: {text}" for text in _grid_notes(grid, group)]
    return Design(tuple(picks), tuple(notes))


def _reason(cell: Cell, gpu: str) -> str:
    cpus, memory = cell.levels
    beside = "" if gpu_type(gpu) is None else f" with {gpu}"
    return f"{cpus} vCPUs ({cell.vcpus:g}), {memory} memory ({cell.memory_gib:g} GiB){beside}"


def _grid_notes(grid: Grid, group: Catalog) -> Iterator[str]:
    for level in grid.skipped:
        other = "smallest" if level == "largest" else "smallest or largest"
        yield f"the {level} vCPU count is also the {other}: its cells are skipped"
    for cell in grid.cells:
        what = f"{cell.vcpus:g} vCPUs with {cell.levels[1]} memory"
        if cell.snapped:
            yield f"{what}: no machine has {cell.asked_gib:g} GiB, the nearest on offer is {cell.memory_gib:g} GiB"
        if cell.same_as is not None:
            yield f"{what}: {group.instance[cell.row]} again, sampled once"
        elif group.burstable[cell.row]:
            yield f"{what}: {group.instance[cell.row]} is burstable, its latency depends on CPU credits left"


def _listed(spec: Spec, catalog: Catalog, admissible: Filtered) -> Design:
    picks: list[DesignPoint] = []
    notes: list[str] = []
    admitted = set(admissible.offers.instance.tolist())
    for name in spec.benchmark.machines:
        if shape := local_shape(name):
            cpus, memory_gib = shape
            instance = name.removeprefix("local/")
            here = Machine(infra=LOCAL, instance=instance, cpus=cpus, memory=memory_gib, price=0.0)
            picks.append(DesignPoint(here, "listed in benchmark.machines"))
            continue
        picks += _found(name, spec, catalog)
        if name not in admitted:
            notes.append(f"{name} is listed in benchmark.machines, and is no candidate: hardware does not admit it")
    return Design(tuple(picks), tuple(notes))


def _found(name: str, spec: Spec, catalog: Catalog) -> Iterator[DesignPoint]:
    """The cheapest offer of a listed instance type in each infra that has it, whatever its shape.

    Where one host may carry several accelerators, those that `hardware.gpus` names come first.
    """
    rows = catalog.take(np.asarray(catalog.instance == name, dtype=np.bool_))
    allowed = ~rows.spot | spec.hardware.spot
    places = [merge_zones(rows.take(allowed & matches_infra(rows, entry)), [entry]) for entry in spec.infra]
    if not any(len(place) for place in places):
        close = difflib.get_close_matches(name, sorted(set(catalog.instance.tolist())), n=3)
        where = f" in {', '.join(spec.infra)}" if len(rows) else ""
        hints = [f"did you mean {', '.join(close)}?"] if close and not len(rows) else []
        raise InvalidInput(f"spec.benchmark.machines: the catalog has no instance type {name!r}{where}", *hints)
    for place in filter(len, places):
        named = (place.take(matches_gpu(place, gpu)) for gpu in spec.hardware.gpus)
        best = next(filter(len, named), place)
        yield DesignPoint(best.machine(int(cheapest_first(best)[0])), "listed in benchmark.machines")


def _unknown_places(infra: Sequence[str], catalog: Catalog) -> Iterator[str]:
    """What to say of entries of `infra` where the catalog has no machine at all."""
    for entry in infra:
        if matches_infra(catalog, entry).any():
            continue
        places = {*catalog.cloud, *map("/".join, zip(catalog.cloud, catalog.region, strict=True))}
        close = difflib.get_close_matches(entry, sorted(places), n=3)
        hint = ""
        if close:
            hint = f"; did you mean {', '.join(close)}?"
        elif cloud_name(entry) not in places:
            hint = "; --catalog takes a list of its machines and prices, and fogspec lock pins it"
        yield f"the catalog has no machine in {entry}{hint}"


def _distinct(found: Design) -> Design:
    """Overlapping entries of `infra` find the same machine twice: it is measured once."""
    first: dict[str, DesignPoint] = {}
    notes = list(found.notes)
    for one in found.picks:
        if one.id in first:
            notes.append(f"{one.machine.infra} {one.machine.instance} is found twice, sampled once")
        first.setdefault(one.id, one)
    return Design(tuple(first.values()), tuple(notes))
