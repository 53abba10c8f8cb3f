"""The design of a benchmark: the grid of section 2.A for each infra and GPU type, a first batch, or a list of machines."""

import difflib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fogspec.base import units
from fogspec.base.clouds import LOCAL
from fogspec.base.errors import Infeasible, InvalidInput
from fogspec.catalog.classes import platforms
from fogspec.catalog.filters import (
    Filtered,
    before_empty,
    filter_offers,
    gpu_type,
    matches_gpu,
    matches_infra,
    merge_zones,
    unknown_places,
)
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import About, Catalog, Floats, ranks
from fogspec.numerics.design import Cell, Grid, edge_grid
from fogspec.plan.commitment import Commitment
from fogspec.plan.parts import nested_notes, with_parts
from fogspec.plan.schema import (
    NO_PINS,
    ApplicationRef,
    CatalogRef,
    Plan,
    PlanBody,
    PlanMetadata,
    Sample,
    Sampler,
    estimate,
    sample_on,
)
from fogspec.spec import fingerprints
from fogspec.spec.lockfile import image_named, is_pinned
from fogspec.spec.schema import Application, Benchmark, Spec, local_shape

if TYPE_CHECKING:
    from fogspec.numerics.priors import PriorData


@dataclass(frozen=True, slots=True)
class Design:
    """The samples, and notes on how they were chosen."""

    samples: tuple[Sample, ...]
    notes: tuple[str, ...]


def make_plan(
    application: Application,
    path: str,
    catalog: Catalog,
    *,
    pins: Mapping[str, str] = NO_PINS,
    admissible: Filtered | None = None,
    library: "PriorData | None" = None,
) -> Plan:
    """Return the sampling plan of a spec at `path` (as written into the plan), without its tasks.

    Pure: it depends on the values of the spec and the content of the catalog, not on the order of either. Raises
    Infeasible if no machine on offer is admissible, InvalidInput for a listed machine that is not on offer. The budget is
    checked where money would be spent.
    """
    spec = application.spec
    if admissible is None:
        admissible = filter_offers(catalog, spec.hardware, spec.infra)
    found = design(spec, catalog, admissible, library)
    sampler: Sampler = "list" if spec.benchmark.machines else spec.benchmark.sampler
    return plan_of(application, path, catalog.about, sampler=sampler, design=found, pins=pins)


def plan_of(
    application: Application,
    path: str,
    about: About,
    *,
    sampler: Sampler,
    design: Design,
    pins: Mapping[str, str] = NO_PINS,
) -> Plan:
    """Return a plan of these samples, with its maximum cost."""
    spec, benchmark = application.spec, application.spec.benchmark
    stop = benchmark.stop
    body = PlanBody(
        application=ApplicationRef(
            path=path,
            digest=fingerprints.planned_digest(application),
            field_digests=fingerprints.measured_fields(application),
        ),
        pins=dict(pins),
        catalog=CatalogRef(source=about.source, revision=about.revision, date=about.date, digest=about.digest),
        design_catalog=about.digest,
        hardware=spec.hardware,
        infra=spec.infra,
        sampler=sampler,
        shapes="nested" if benchmark.shapes == "nested" else None,
        requests=stop.requests,
        duration=stop.duration,
        warmup=benchmark.warmup,
        setup_timeout=benchmark.setup_timeout,
        budget=benchmark.budget,
        estimate=estimate(design.samples, commitment(spec)),
        samples=list(design.samples),
        notes=[*design.notes, *_unpinned(application, pins)],
    )
    return Plan(metadata=PlanMetadata(name=application.metadata.name), spec=body)


def _unpinned(application: Application, pins: Mapping[str, str]) -> list[str]:
    image = image_named(application)
    return (
        []
        if image is None or is_pinned(image) or "image" in pins
        else [f"image {image} is not pinned to a digest: fogspec lock"]
    )


def design(spec: Spec, catalog: Catalog, admissible: Filtered, library: "PriorData | None" = None) -> Design:
    """Return the samples of the spec's sampler; the adaptive one uses the performance priors in `library`.

    Raises Infeasible if there are none, InvalidInput for an unknown instance type.
    """
    if spec.benchmark.machines:
        found = _listed(spec, catalog, admissible)
        if commitment(spec).nested:
            samples = tuple(with_parts(one, catalog) for one in found.samples)
            found = Design(samples, (*found.notes, *nested_notes(samples, commitment(spec))))
    elif spec.benchmark.sampler == "adaptive":
        found = _adaptive(spec, admissible, library)
    else:
        found = _grid(spec, admissible)
    if not found.samples:
        instead = before_empty(catalog, spec.hardware, spec.infra)
        further = filter(None, (instead, admissible.left_out_line(), *(() if len(catalog) else catalog.about.notes)))
        hints = [admissible.funnel.line(), *unknown_places(spec.infra, catalog), *further]
        raise Infeasible("no machine on offer is admissible", *hints)
    return _distinct(found)


def cheapest_first(offers: Catalog) -> NDArray[np.intp]:
    """Return row numbers in the order of price, then of instance, region and zone."""
    names = (offers.gpu, offers.zone, offers.region, offers.cloud, offers.instance)
    return np.lexsort((offers.spot, *(ranks(name) for name in names), offers.price_usd_per_hour))


def max_cost_usd(spec: Spec, price_usd_per_hour: Floats) -> Floats:
    """Return the maximum cost in USD of one sample of each machine."""
    return price_usd_per_hour * commitment(spec).paid_s / 3600


def commitment(spec: Spec) -> Commitment:
    """Return the times that a sample of this spec is paid for at most."""
    return Commitment.of(spec.benchmark)


def _adaptive(spec: Spec, admissible: Filtered, library: "PriorData | None") -> Design:
    """Return the first batch; `fogspec.choice.next_samples` chooses the next ones after it was measured."""
    from fogspec.plan.initial_batch import initial_batch

    offers, budget = admissible.offers, spec.benchmark.budget
    if not len(offers):
        return Design((), ())
    usd = max_cost_usd(spec, offers.price_usd_per_hour)
    left = math.inf if budget is None else max(budget, float(usd.min()))
    batch = initial_batch(offers, usd, left, library, spec.benchmark)
    samples = tuple(
        with_parts(sample_on(offers.machine(row), why), offers, batch.part_types(offers, i))
        for i, (row, why) in enumerate(zip(batch.rows, batch.reasons, strict=True))
    )
    nested = nested_notes(samples, commitment(spec)) if commitment(spec).nested else ()
    return Design(samples, (_later(spec.benchmark, offers), *nested))


def _later(benchmark: Benchmark, offers: Catalog) -> str:
    from fogspec.catalog.instance_types import instance_types
    from fogspec.numerics.acquisition import Policy

    at_once = "one by one" if benchmark.batch_size in (None, 1) else f"{benchmark.batch_size} at once"
    if benchmark.wall_time is not None and benchmark.batch_size is None:
        at_once = f"as many at once as {units.shown_duration(benchmark.wall_time)} needs"
    bounds = []
    if benchmark.volume is not None:
        requests = f"{benchmark.volume.requests:,.0f} requests"
        bounds.append(f"as long as the next is expected to save more than its price on {requests}")
    policy = Policy(worth=None if benchmark.volume is None else 1.0)
    most = f"{policy.bound(len(instance_types(offers)))} samples: there is no budget"
    if benchmark.budget is not None:
        most = f"the budget of {units.dollars(benchmark.budget)}"
    bounds.append(f"never beyond {most}")
    return f"the first batch; then the model selects the next machines, {at_once}, {', '.join(bounds)}"


def _grid(spec: Spec, admissible: Filtered) -> Design:
    samples: list[Sample] = []
    notes: list[str] = []
    offers = admissible.offers
    for entry in spec.infra:
        here = matches_infra(offers, entry)
        for gpu in spec.hardware.gpus:
            group = offers.take(here & matches_gpu(offers, gpu))
            if not len(group):
                notes.append(f"{entry}, GPU {gpu}: no admissible machine, nothing is sampled")
                continue
            group, others = _of_one_platform(group)
            notes += [f"{entry}, GPU {gpu}: {text}" for text in others]
            grid = edge_grid(group.vcpus, group.memory_gib, cheapest_first(group))
            samples += [
                sample_on(group.machine(cell.row), _reason(cell, gpu)) for cell in grid.cells if cell.same_as is None
            ]
            notes += [f"{entry}, GPU {gpu}: {text}" for text in _grid_notes(grid, group)]
    return Design(tuple(samples), tuple(notes))


def _of_one_platform(group: Catalog) -> tuple[Catalog, list[str]]:
    """Return the machines of one kind of CPU, so that the grid compares sizes and not generations; a note on others.

    It is the kind whose vCPUs and memory span most, then the one with the cheapest machines in its cells.
    """
    kinds = platforms(group)
    names = sorted(set(kinds.tolist()))
    if len(names) == 1:
        return group, []
    parts = {name: group.take(np.asarray(kinds == name, dtype=np.bool_)) for name in names}
    best = min(parts, key=lambda name: (-_span(parts[name]), _grid_price(parts[name]), name))
    families = ", ".join(sorted(set(parts[best].family.tolist())))
    return parts[best], [f"sizes of one kind of CPU, {families}; sampler: adaptive compares all {len(names)} kinds"]


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


def _grid_notes(grid: Grid, group: Catalog) -> Iterator[str]:
    for level in grid.skipped:
        other = "smallest" if level == "largest" else "smallest or largest"
        yield f"the {level} vCPU count is also the {other}: its cells are skipped"
    for cell in grid.cells:
        what = f"{cell.vcpus:g} vCPUs with {cell.levels[1]} memory"
        if cell.snapped:
            yield f"{what}: no machine has {cell.asked_gib:g} GiB, the nearest on offer is {cell.memory_gib:g} GiB"
        if cell.same_as is not None:
            yield f"{what}: {group.instance[cell.row]} is a duplicate: sampled once"
        elif group.burstable[cell.row]:
            yield f"{what}: {group.instance[cell.row]} is burstable, its latency depends on CPU credits left"


def _listed(spec: Spec, catalog: Catalog, admissible: Filtered) -> Design:
    samples: list[Sample] = []
    notes: list[str] = []
    admitted = set(admissible.offers.instance.tolist())
    for name in spec.benchmark.machines:
        if shape := local_shape(name):
            cpus, memory_gib = shape
            instance = name.removeprefix("local/")
            here = Machine(infra=LOCAL, instance=instance, cpus=cpus, memory=memory_gib, price=0.0)
            samples.append(sample_on(here, "listed in benchmark.machines"))
            continue
        samples += _found(name, spec, catalog)
        if name not in admitted:
            notes.append(f"{name} is listed in benchmark.machines, and is not a candidate: hardware does not admit it")
    return Design(tuple(samples), tuple(notes))


def _found(name: str, spec: Spec, catalog: Catalog) -> Iterator[Sample]:
    """Yield the cheapest offer of a listed instance type in each infra that has it, whatever its shape.

    If one host may carry several accelerators, those in `hardware.gpus` come first.
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
        yield sample_on(best.machine(int(cheapest_first(best)[0])), "listed in benchmark.machines")


def _distinct(found: Design) -> Design:
    """Return the design with each machine once: overlapping entries of `infra` find the same machine twice."""
    first: dict[str, Sample] = {}
    notes = list(found.notes)
    for one in found.samples:
        if one.id in first:
            notes.append(f"{one.machine.infra} {one.machine.instance} is a duplicate: sampled once")
        first.setdefault(one.id, one)
    return Design(tuple(first.values()), tuple(notes))
