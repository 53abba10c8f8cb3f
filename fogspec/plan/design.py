"""The design of a benchmark: the grid of section 2.A for each infra and GPU type, a first batch, or a list of machines."""

import difflib
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fogspec.base.errors import Infeasible, InvalidInput
from fogspec.catalog.classes import platforms, startable, takes_images
from fogspec.catalog.filters import (
    Filtered,
    before_empty,
    field_against,
    gpu_type,
    in_zones,
    matches_gpu,
    matches_infra,
    merge_zones,
    offers_for,
    unknown_places,
)
from fogspec.catalog.machine import Machine, host_shape
from fogspec.catalog.table import About, Catalog, Floats, ranks
from fogspec.language import warned as codes
from fogspec.language.fingerprints import IMAGE, measured_record
from fogspec.language.lockfile import image_named
from fogspec.language.schema import Application, Benchmark, Sampler, Spec
from fogspec.language.warned import Warned, warned
from fogspec.numerics.design import Cell, Grid, edge_grid
from fogspec.plan.commitment import Commitment
from fogspec.plan.schema import (
    CatalogRef,
    Plan,
    PlanBody,
    PlanMetadata,
    Sample,
    estimate,
    is_apart,
    sample_id,
    sample_on,
    settings_of,
)


@dataclass(frozen=True, slots=True)
class Design:
    """The samples, and notes on how they were chosen."""

    samples: tuple[Sample, ...]
    notes: tuple[Warned, ...]


def make_plan(
    application: Application,
    catalog: Catalog,
    *,
    inputs: Mapping[str, Any] | None = None,
    admissible: Filtered | None = None,
    measured: Mapping[str, Machine] | None = None,
) -> Plan:
    """Return the sampling plan of a spec, without its tasks; `inputs` is the record of what is measured, if files are sent.

    Pure: it depends on the values of the spec and the content of the catalog, not on the order of either; a machine that was
    `measured` keeps the id of its sample. Raises
    Infeasible if no machine on offer is admissible, InvalidInput for a listed machine that is not on offer. The budget is
    checked where money would be spent.
    """
    spec = application.spec
    if admissible is None:
        admissible = offers_for(catalog, spec)
    found = design(spec, catalog, admissible, measured)
    return plan_of(application, catalog.about, sampler=spec.sampler, design=found, inputs=inputs)


def plan_of(
    application: Application,
    about: About,
    *,
    sampler: Sampler,
    design: Design,
    inputs: Mapping[str, Any] | None = None,
) -> Plan:
    """Return a plan of these samples, with its maximum cost."""
    spec, benchmark = application.spec, application.spec.benchmark
    record = measured_record(application) if inputs is None else inputs
    body = PlanBody(
        inputs=dict(record),
        catalog=CatalogRef.of(about),
        hardware=spec.hardware.search_space,
        infra=spec.infra,
        sampler=sampler,
        **settings_of(benchmark),
        budget=benchmark.budget,
        estimate=estimate(design.samples, commitment(spec)),
        samples=list(design.samples),
        notes=[*design.notes, *_unpinned(application, record)],
    )
    return Plan(metadata=PlanMetadata(name=application.metadata.name), spec=body)


def _unpinned(application: Application, record: Mapping[str, Any]) -> list[Warned]:
    image = image_named(application)
    return [] if image is None or IMAGE in record else [warned(codes.image_unpinned, image=image)]


def design(spec: Spec, catalog: Catalog, admissible: Filtered, measured: Mapping[str, Machine] | None = None) -> Design:
    """Return the samples of the spec's sampler.

    Raises Infeasible if there are none, InvalidInput for an unknown instance type.
    """
    if spec.benchmark.machines:
        found = _listed(spec, catalog, admissible, measured or {})
    elif spec.sampler == "list":
        offers = admissible.offers
        found = Design(
            tuple(sample_on(offers.machine(row), "measuring here is free") for row in range(len(offers))), ()
        )
    elif spec.sampler == "adaptive":
        found = _adaptive(spec, admissible)
    else:
        found = _grid(spec, admissible)
    if not found.samples:
        instead = before_empty(catalog, spec.hardware, spec.infra)
        further = filter(None, (instead, admissible.left_out_line(), *(() if len(catalog) else catalog.about.notes)))
        hints = [admissible.funnel.line(), *unknown_places(spec.infra, catalog), *further]
        raise Infeasible("no machine on offer is admissible", *hints)
    return _distinct(found, measured or {})


def cheapest_first(offers: Catalog) -> NDArray[np.intp]:
    """Return row numbers in the order of price, then of instance, region and zone."""
    names = (offers.gpu, offers.zone, offers.region, offers.cloud, offers.instance)
    return np.lexsort((offers.spot, *(ranks(name) for name in names), offers.price_usd_per_hour))


def max_cost_usd(spec: Spec, offers: Catalog) -> Floats:
    """Return the maximum cost in USD of one sample of each machine."""
    return commitment(spec).usd(offers)


def commitment(spec: Spec) -> Commitment:
    """Return the times that a sample of this spec is paid for at most."""
    return Commitment.of(spec.benchmark)


def _adaptive(spec: Spec, admissible: Filtered) -> Design:
    """Return the first batch; `fogspec.choice.next_samples` chooses the next ones after it was measured."""
    from fogspec.plan.initial_batch import initial_batch

    offers, budget = admissible.offers, spec.benchmark.budget
    if not len(offers):
        return Design((), ())
    usd = max_cost_usd(spec, offers)
    left = math.inf if budget is None else max(budget, float(usd.min()))
    batch = initial_batch(offers, usd, left)
    samples = tuple(sample_on(offers.machine(row), why) for row, why in zip(batch.rows, batch.reasons, strict=True))
    return Design(samples, (_later(spec.benchmark),))


def _later(benchmark: Benchmark) -> Warned:
    return warned(codes.selects_more, at_once=benchmark.batch_size, budget_usd=benchmark.budget)


def _grid(spec: Spec, admissible: Filtered) -> Design:
    samples: list[Sample] = []
    notes: list[Warned] = []
    offers = admissible.offers
    for entry in spec.infra:
        here = matches_infra(offers, entry)
        for gpu in spec.hardware.gpus:
            group = offers.take(here & matches_gpu(offers, gpu))
            if not len(group):
                notes.append(warned(codes.nothing_sampled, infra=entry, gpu=gpu))
                continue
            group, kinds = _of_one_platform(group)
            if kinds > 1:
                families = sorted(set(group.family.tolist()))
                notes.append(warned(codes.one_platform, infra=entry, gpu=gpu, families=families, kinds=kinds))
            grid = edge_grid(group.vcpus, group.memory_gib, cheapest_first(group))
            samples += [
                sample_on(group.machine(cell.row), _reason(cell, gpu)) for cell in grid.cells if cell.same_as is None
            ]
            for one in _grid_notes(grid, group, entry, gpu):
                notes += [one] if one not in notes else []
    return Design(tuple(samples), tuple(notes))


def _of_one_platform(group: Catalog) -> tuple[Catalog, int]:
    """Return the machines of one kind of CPU, so that the grid compares sizes and not generations; how many kinds there are.

    It is the kind whose vCPUs and memory span most, then the one with the cheapest machines in its cells.
    """
    kinds = platforms(group)
    names = sorted(set(kinds.tolist()))
    if len(names) == 1:
        return group, 1
    parts = {name: group.take(np.asarray(kinds == name, dtype=np.bool_)) for name in names}
    best = min(parts, key=lambda name: (-_span(parts[name]), _grid_price(parts[name]), name))
    return parts[best], len(names)


def _span(group: Catalog) -> float:
    """Return how many doublings lie between the smallest and the largest vCPU count and memory."""
    return float(sum(np.log2(values.max() / values.min()) for values in (group.vcpus, group.memory_gib)).round(6))


def _grid_price(group: Catalog) -> float:
    cells = edge_grid(group.vcpus, group.memory_gib, cheapest_first(group)).cells
    return float(sum(group.price_usd_per_hour[cell.row] for cell in cells if cell.same_as is None))


def _reason(cell: Cell, gpu: str) -> str:
    cpus, memory = cell.levels
    beside = "" if gpu_type(gpu) is None else f" with {gpu}"
    return f"{cpus} vCPUs ({cell.vcpus:g}), {memory} memory ({cell.memory_gib:g} GiB){beside}"


def _grid_notes(grid: Grid, group: Catalog, infra: str, gpu: str) -> Iterator[Warned]:
    for level in grid.skipped:
        yield warned(codes.level_skipped, infra=infra, gpu=gpu, level=level)
    for cell in grid.cells:
        machine = str(group.instance[cell.row])
        if cell.snapped:
            yield warned(
                codes.memory_snapped,
                infra=infra,
                gpu=gpu,
                vcpus=cell.vcpus,
                level=cell.levels[1],
                wanted_gib=cell.asked_gib,
                memory_gib=cell.memory_gib,
            )
        if cell.same_as is not None:
            yield warned(codes.sampled_once, infra=infra, machine=machine)
        elif group.burstable[cell.row]:
            yield warned(codes.burstable, infra=infra, machine=machine)


def _listed(spec: Spec, catalog: Catalog, admissible: Filtered, measured: Mapping[str, Machine]) -> Design:
    """Return the listed machines; raise InvalidInput for one to be rented that the spec keeps from being chosen."""
    samples: list[Sample] = []
    admitted = {*admissible.offers.instance.tolist(), *(one.instance for one in measured.values())}
    for name in spec.benchmark.machines:
        if here := host_shape(name):
            samples.append(sample_on(here, "listed in benchmark.machines"))
            continue
        found = list(_found(name, spec, catalog))
        if name not in admitted:
            machine = found[0].machine
            field = field_against(machine, spec.hardware, spec.infra) or "hardware.allow"
            has = {"hardware.gpus": f", it has {machine.gpu_key}", "hardware.allow": ", for its class"}.get(field, "")
            raise InvalidInput(
                f"spec.benchmark.machines: {name} could never be chosen: spec.{field} does not admit it{has}",
                f"admit it in spec.{field}, or leave it out",
                *filter(None, [admissible.left_out_line() if field == "hardware.allow" else None]),
            )
        samples += found
    return Design(tuple(samples), ())


def _found(name: str, spec: Spec, catalog: Catalog) -> Iterator[Sample]:
    """Yield the cheapest offer of a listed instance type in each infra that has it, whatever its shape.

    If one host may carry several accelerators, those in `hardware.gpus` come first.
    """
    rows = in_zones(catalog.take(np.asarray(catalog.instance == name, dtype=np.bool_)), spec.infra)
    allowed = ~rows.spot | bool(spec.hardware.spot)
    places = [merge_zones(rows.take(allowed & matches_infra(rows, entry)), [entry]) for entry in spec.infra]
    if not any(len(place) for place in places):
        close = difflib.get_close_matches(name, sorted(set(catalog.instance.tolist())), n=3)
        where = f" in {', '.join(spec.infra)}" if len(rows) else ""
        hints = [f"did you mean {', '.join(close)}?"] if close and not len(rows) else []
        raise InvalidInput(f"spec.benchmark.machines: the catalog has no instance type {name!r}{where}", *hints)
    places = [place.take(startable(place)) for place in places]
    if not any(len(place) for place in places):
        raise InvalidInput(
            f"spec.benchmark.machines: SkyPilot cannot start {name!r} in {', '.join(spec.infra)}",
            "it requests a disk type, an image or an end that they do not support: name another machine, or another place",
        )
    if spec.ros is not None and spec.ros.image is not None:
        places = [place.take(takes_images(place)) for place in places]
        if not any(len(place) for place in places):
            raise InvalidInput(
                f"spec.benchmark.machines: SkyPilot starts no container images where {name!r} is",
                "leave out spec.ros.image, or name another place in spec.infra",
            )
    for place in filter(len, places):
        named = (place.take(matches_gpu(place, gpu)) for gpu in spec.hardware.gpus)
        best = next(filter(len, named), place)
        yield sample_on(best.machine(int(cheapest_first(best)[0])), "listed in benchmark.machines")


def _distinct(found: Design, measured: Mapping[str, Machine]) -> Design:
    """Return the design with each machine once: overlapping entries of `infra` find the same machine twice.

    Two machines with one id are both kept apart, unless one was measured under it.
    """
    first: dict[Any, Sample] = {}
    notes = list(found.notes)
    for one in found.samples:
        if one.machine.identity in first:
            notes.append(warned(codes.sampled_once, infra=one.machine.infra, machine=one.machine.instance))
        first.setdefault(one.machine.identity, one)
    shared = Counter(one.id for one in first.values())
    samples = [
        one.model_copy(update={"id": sample_id(one.machine, apart=True)})
        if is_apart(one.machine, measured) or (shared[one.id] > 1 and one.id not in measured)
        else one
        for one in first.values()
    ]
    return Design(tuple(samples), tuple(notes))
