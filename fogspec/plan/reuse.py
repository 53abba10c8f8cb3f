"""Reuse of a measured plan: a narrower search space or new prices cost no new samples; whether a campaign continues."""

from collections.abc import Mapping, Sequence

from fogspec.base import digest, units
from fogspec.base.units import Range
from fogspec.catalog.filters import price_now
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.plan.design import Design, commitment, plan_of
from fogspec.plan.schema import (
    NO_PINS,
    ApplicationRef,
    CatalogRef,
    Plan,
    PlanBody,
    Sample,
    Sampling,
    estimate,
)
from fogspec.spec import fingerprints
from fogspec.spec.schema import Application, Hardware


def reuse_plan(
    application: Application, plan: Plan, catalog: Catalog, pins: Mapping[str, str] = NO_PINS
) -> Plan | None:
    """Return the plan with the prices of this catalog, or None if the spec needs another plan.

    The plan is reused if its samples are measured in the same way and the search space that they were chosen from contains
    the spec's. A machine that is no longer on offer keeps its price.
    """
    spec, body = application.spec, plan.spec
    stop, benchmark = spec.benchmark.stop, spec.benchmark
    same = (
        not benchmark.machines
        and plan.metadata.name == application.metadata.name
        and body.application.field_digests == fingerprints.measured_fields(application)
        and body.pins == dict(pins)
        and (body.sampler, body.requests, body.duration, body.warmup, body.setup_timeout)
        == (benchmark.sampler, stop.requests, stop.duration, benchmark.warmup, benchmark.setup_timeout)
        and (body.shapes or "own") == benchmark.shapes
        and contains(body.hardware, body.infra, spec.hardware, spec.infra)
    )
    if not same:
        return None
    samples = [
        sample.model_copy(update={"machine": _repriced(sample.machine, catalog), "task": None})
        for sample in body.samples
    ]
    return Plan(metadata=plan.metadata, spec=_with(application, body, catalog, samples))


def plan_from_campaign(
    application: Application, path: str, catalog: Catalog, sampling: Sampling, pins: Mapping[str, str] = NO_PINS
) -> Plan:
    """Return the plan of an adaptive campaign: the samples requested so far, at the prices of this catalog.

    Its search space is the one that they were chosen from, as long as that contains the spec's.
    """
    samples = [
        one.model_copy(update={"machine": _repriced(one.machine, catalog), "task": None})
        for batch in sampling.batches
        for one in batch.samples
    ]
    notes = [
        f"batch {number} ({len(batch.samples)}): {batch.reason}" for number, batch in enumerate(sampling.batches, 1)
    ]
    notes.append(
        f"sampling ended: {sampling.stop_reason}" if sampling.stop_reason else "fogspec bench selects the next machines"
    )
    design = Design(tuple(samples), tuple(notes))
    plan = plan_of(application, path, catalog.about, sampler="adaptive", design=design, pins=pins)
    if not covers(application, sampling):
        return plan
    search_space = {"hardware": sampling.hardware, "infra": sampling.infra}
    return plan.model_copy(update={"spec": plan.spec.model_copy(update=search_space)})


def covers(application: Application, sampling: Sampling) -> bool:
    """Return whether the search space of the campaign contains the spec's."""
    return contains(sampling.hardware, sampling.infra, application.spec.hardware, application.spec.infra)


def selects_more(application: Application, sampler: str, sampling: Sampling | None) -> bool:
    """Return whether the model will still select machines to measure: an adaptive campaign that did not end, or resumes."""
    if sampler != "adaptive":
        return False
    return sampling is None or sampling.stop_reason is None or should_resume(application, sampling)


def should_resume(application: Application, sampling: Sampling) -> bool:
    """Return whether a campaign that ended resumes: for other limits, a larger search space, or more money."""
    same = sampling.limits_digest == limits_of(application) and covers(application, sampling)
    return sampling.out_of_budget or not same


def limits_of(application: Application) -> str:
    """Return a short digest of the limits, the objective and what bounds sampling: they decide what is sampled."""
    chosen = fingerprints.chosen_part(application)
    parts = {name: chosen[name] for name in ("constraints", "objective", "metrics")}
    bounding = {"volume", "wall_time", *(["servers"] if application.spec.benchmark.servers > 1 else [])}
    benchmark = application.spec.benchmark.model_dump(mode="json", include=bounding, exclude_none=True)
    return digest.shorten(digest.of_value(parts | ({"benchmark": benchmark} if benchmark else {})))


def price_rises(samples: Sequence[Sample], catalog: Catalog) -> list[str]:
    """Return a line for each sample that is more expensive than in the plan or no longer on offer."""
    found = []
    for sample in samples:
        machine, now = sample.machine, price_now(sample.machine, catalog)
        if machine.is_local:
            continue
        name = f"{sample.id}: {machine.infra} {machine.instance}"
        if now is None:
            found.append(f"{name} is not on offer in {catalog.about.source}")
        elif now > machine.price * (1 + 1e-6):
            price, planned = units.shown_apart(now, machine.price, units.shown_price)
            found.append(f"{name} costs {price}, the plan says {planned}")
    return found


def _with(application: Application, body: PlanBody, catalog: Catalog, samples: Sequence[Sample]) -> PlanBody:
    about, benchmark = catalog.about, application.spec.benchmark
    return body.model_copy(
        update={
            "application": ApplicationRef(
                path=body.application.path,
                digest=fingerprints.planned_digest(application),
                field_digests=body.application.field_digests,
            ),
            "catalog": CatalogRef(source=about.source, revision=about.revision, date=about.date, digest=about.digest),
            "budget": benchmark.budget,
            "estimate": estimate(samples, commitment(application.spec)),
            "samples": list(samples),
        }
    )


def _repriced(machine: Machine, catalog: Catalog) -> Machine:
    """Return the machine at its price now; one that is no longer on offer keeps its price."""
    price = None if machine.is_local else price_now(machine, catalog)
    return machine if price is None else machine.model_copy(update={"price": price})


def contains(outer: Hardware, outer_infra: Sequence[str], inner: Hardware, inner_infra: Sequence[str]) -> bool:
    """Return whether every machine of the inner search space is in the outer one, judged by the specs alone."""
    allow = outer.machines.allow
    return (
        all(_within(getattr(outer, name), getattr(inner, name)) for name in ("cpus", "memory", "memory_per_cpu"))
        and {*inner.gpus} <= {*outer.gpus}
        and {*inner.arch} <= {*outer.arch}
        and (outer.spot or not inner.spot)
        and {*outer.machines.deny} <= {*inner.machines.deny}
        and (not allow or (bool(inner.machines.allow) and all(_is_covered(allow, one) for one in inner.machines.allow)))
        and all(any(one == other or one.startswith(f"{other}/") for other in outer_infra) for one in inner_infra)
    )


def _within(outer: Range | None, inner: Range | None) -> bool:
    if outer is None or inner is None:
        return outer is None
    low = outer.low is None or (inner.low is not None and inner.low >= outer.low)
    return low and (outer.high is None or (inner.high is not None and inner.high <= outer.high))


def _is_covered(patterns: Sequence[str], one: str) -> bool:
    """Return whether one of the patterns matches all that `one` matches: `c6i.*` covers `c6i.large`."""
    return one in patterns or any(
        pattern.count("*") == 1 and pattern.endswith("*") and one.startswith(pattern[:-1]) for pattern in patterns
    )
