"""Reuse of a measured plan: a narrower search space or new prices cost no new samples; whether a campaign continues."""

from collections.abc import Mapping, Sequence
from typing import Any

from fogspec.base import digest, units
from fogspec.base.clouds import LOCAL
from fogspec.base.units import Range
from fogspec.catalog.filters import price_now
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.language import warned as codes
from fogspec.language.fingerprints import differing_rows, part_read_by
from fogspec.language.schema import CLASSES, STANDARD, Application, Hardware
from fogspec.language.warned import warned
from fogspec.plan.design import Design, commitment, plan_of
from fogspec.plan.schema import (
    SETTINGS,
    CatalogRef,
    Plan,
    PlanBody,
    PlanMetadata,
    Sample,
    Sampling,
    estimate,
    settings_of,
)


def reuse_plan(application: Application, plan: Plan, catalog: Catalog, inputs: Mapping[str, Any]) -> Plan | None:
    """Return the plan with the prices of this catalog, or None if the spec needs another plan.

    The plan is reused if its samples are measured in the same way and the search space that they were chosen from contains
    the spec's, whatever name it was made under. A machine that is no longer on offer keeps its price.
    """
    if (
        differing_rows(plan.spec.inputs, inputs)
        or application.spec.benchmark.machines
        or settings_changed(application, plan)
    ):
        return None
    samples = [
        sample.model_copy(update={"machine": _repriced(sample.machine, catalog), "task": None})
        for sample in plan.spec.samples
    ]
    return Plan(
        metadata=PlanMetadata(name=application.metadata.name), spec=_with(application, plan.spec, catalog, samples)
    )


def settings_changed(application: Application, plan: Plan) -> list[str]:
    """Return the fields of the spec by which samples would be selected or measured otherwise than in the plan."""
    spec, body = application.spec, plan.spec
    same = {
        "spec.hardware or spec.infra": contains(body.hardware, body.infra, spec.hardware, spec.infra),
        "spec.benchmark.sampler": body.sampler == spec.sampler,
    }
    settings = settings_of(spec.benchmark)
    same |= {f"spec.benchmark.{path}": getattr(body, name) == settings[name] for name, path in SETTINGS.items()}
    return [name for name, unchanged in same.items() if not unchanged]


def picks_changed(application: Application, plan: Plan, measured: bool) -> list[str]:
    """Return the fields of the spec by which other samples would be picked than the plan's, of which all may be `measured`."""
    changed, spec, body = settings_changed(application, plan), application.spec, plan.spec
    space = "spec.hardware or spec.infra"
    if not measured and space not in changed and (body.hardware, body.infra) != (spec.hardware, spec.infra):
        changed.append(space)
    listed = {name.removeprefix(f"{LOCAL}/") for name in spec.benchmark.machines}
    if listed and listed != {sample.machine.instance for sample in body.samples}:
        changed.append("spec.benchmark.machines")
    return changed


def kept_plan(application: Application, plan: Plan, catalog: Catalog, inputs: Mapping[str, Any]) -> Plan:
    """Return the plan with what is measured now and the budget of the spec; `catalog` has its machines."""
    samples = [sample.model_copy(update={"task": None}) for sample in plan.spec.samples]
    body = _with(application, plan.spec, catalog, samples).model_copy(update={"inputs": dict(inputs)})
    return plan.model_copy(update={"spec": body})


def plan_from_campaign(
    application: Application, catalog: Catalog, sampling: Sampling, inputs: Mapping[str, Any]
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
        warned(codes.batch, number=number, samples=len(batch.samples), reason=batch.reason)
        for number, batch in enumerate(sampling.batches, 1)
    ]
    ended = sampling.stop_reason
    notes.append(warned(codes.sampling_ended, reason=ended) if ended else warned(codes.selects_more))
    design = Design(tuple(samples), tuple(notes))
    plan = plan_of(application, catalog.about, sampler="adaptive", design=design, inputs=inputs)
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
    chosen = part_read_by("choice", application)["spec"]
    parts = {name: chosen[name] for name in ("constraints", "objective", "metrics")}
    hardware = application.spec.hardware
    parts["hardware"] = [hardware.interruptions_per_s, hardware.startup]
    servers = application.spec.benchmark.servers
    return digest.shorten(digest.of_value(parts | ({"benchmark": {"servers": servers}} if servers > 1 else {})))


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
            "catalog": CatalogRef.of(about),
            "design_catalog": None if body.designed_from == about.digest else body.designed_from,
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
    return (
        all(_within(getattr(outer, name), getattr(inner, name)) for name in ("cpus", "memory", "memory_per_cpu"))
        and {*inner.gpus} <= {*outer.gpus}
        and {*inner.arch} <= {*outer.arch}
        and (bool(outer.spot) or not inner.spot)
        and {*outer.deny} <= {*inner.deny}
        and all(_is_covered(outer.allow, one) for one in inner.allow)
        and all(any(one == other or one.startswith(f"{other}/") for other in outer_infra) for one in inner_infra)
    )


def _within(outer: Range | None, inner: Range | None) -> bool:
    if outer is None or inner is None:
        return outer is None
    low = outer.low is None or (inner.low is not None and inner.low >= outer.low)
    return low and (outer.high is None or (inner.high is not None and inner.high <= outer.high))


def _is_covered(patterns: Sequence[str], one: str) -> bool:
    """Return whether one of the entries admits all that `one` does: `c6i.*` covers `c6i.large`, standard every name."""
    if one in CLASSES:
        return one in patterns or "*" in patterns
    return bool({one, STANDARD} & {*patterns}) or any(
        pattern.count("*") == 1 and pattern.endswith("*") and one.startswith(pattern[:-1]) for pattern in patterns
    )
