"""What each stage reads of a spec, from what the spec's own fields declare (`fogspec.spec.schema.affects`).

A change elsewhere leaves the stage's files fresh. Digests are over values in a canonical form, which stays the same.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic.fields import FieldInfo

from fogspec.base import digest
from fogspec.base.clouds import LOCAL
from fogspec.base.quantities import Strict
from fogspec.spec.introspect import part
from fogspec.spec.schema import Affects, Application, Benchmark, Stage

NOTHING: frozenset[Stage] = frozenset()
# Parts of what is measured that a waiver may name; the others define the figures themselves.
WAIVABLE = ("cloud", "ros", "workload", "secrets")
# To the benchmark, after plans were first written: what each was before.
ADDED = {"volume": None, "wall_time": None, "batch_size": None, "shapes": "own", "servers": 1}


def stages_of_fields(
    model: type[Strict] = Application, inherited: frozenset[Stage] | None = None, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], frozenset[Stage]]]:
    """Yield the path of every leaf field, and the stages that read it; `*` stands for the items of a list or mapping.

    Raise TypeError for a field for which neither it nor one above it declares stages.
    """
    for name, field in model.model_fields.items():
        stages, here = _declared(field, inherited), (*path, name)
        kind, items = part(field.annotation)
        below = _model(kind) or _model(part(items)[0])
        if below is not None:
            yield from stages_of_fields(below, stages, (*here, "*") if items else here)
        elif stages is None:
            raise TypeError(f"{'.'.join(here)} does not declare which stages it affects")
        else:
            yield here, stages


def part_read_by(stage: Stage, model: Strict, inherited: frozenset[Stage] | None = None) -> dict[str, Any]:
    """Return the values of a document that a stage reads, as JSON has them."""
    return _read(stage, type(model), model.model_dump(mode="json"), inherited)


def measured_part(application: Application) -> dict[str, Any]:
    """Return what a measurement depends on: nodes, environment, probe, metrics, workload.

    What later versions added is omitted while it is not set, so that digests of older results stay valid.
    """
    found = part_read_by("results", application)["spec"]
    flat: dict[str, Any] = {}
    for name, value in found.items():
        flat |= value if name == "benchmark" else {name: value}
    flat["probe"] = {key: value for key, value in flat["probe"].items() if value is not None}
    return {name: value for name, value in flat.items() if name != "scenarios" or value}


def planned_part(application: Application) -> dict[str, Any]:
    """Return what the sampling plan depends on, besides the catalog: also the machines and how they are sampled.

    What later versions added is omitted while it is not set, so that digests of older plans stay valid.
    """
    found = part_read_by("plan", application)
    benchmark = {
        name: value for name, value in found["spec"]["benchmark"].items() if name not in ADDED or value != ADDED[name]
    }
    return {**found["spec"], "benchmark": benchmark, **measured_part(application), **found["metadata"]}


def chosen_part(application: Application) -> dict[str, Any]:
    """Return what choice and deployment depend on, besides results and catalog: limits, objective, admissible machines.

    What later versions added is omitted while it is not set, so that digests of older manifests stay valid.
    """
    chosen: dict[str, Any] = part_read_by("choice", application)["spec"]
    waivers = chosen.pop("benchmark")["waivers"]
    return {**chosen, "benchmark.waivers": waivers} if waivers else chosen


def fitted_part(application: Application) -> dict[str, Any]:
    """Return what the models depend on, besides results and machine library: the statistic, their targets, and this host."""
    spec = application.spec
    targets = {*spec.constraints.metrics, *([spec.objective.metric] if spec.objective.metric else [])}
    return {"statistic": spec.constraints.statistic, "targets": sorted(targets), "local": spec.infra == [LOCAL]}


def field_of_measured(name: str) -> str:
    """Return where the spec has a part of `measured_part`."""
    return f"spec.benchmark.{name}" if name in Benchmark.model_fields else f"spec.{name}"


def waivable(change: str) -> bool:
    """Return whether a waiver may name this change: no field of the spec that defines the figures."""
    named = (field_of_measured(part) for part in WAIVABLE)
    return not change.startswith("spec.") or any(
        change == field or change.startswith((f"{field}.", f"{field}[")) for field in named
    )


def chosen_fields(application: Application) -> dict[str, str]:
    """Return a short digest of each part of `chosen_part`, so that a later change can be named."""
    return {name: digest.shorten(digest.of_value(value)) for name, value in chosen_part(application).items()}


def measured_fields(application: Application) -> dict[str, str]:
    """Return a short digest of each part of `measured_part`, so that a later change can be named."""
    return {name: digest.shorten(digest.of_value(value)) for name, value in measured_part(application).items()}


def measured_digest(application: Application) -> str:
    """Return the digest of `measured_part`."""
    return digest.of_value(measured_part(application))


def planned_digest(application: Application) -> str:
    """Return the digest of `planned_part`."""
    return digest.of_value(planned_part(application))


def chosen_digest(application: Application) -> str:
    """Return the digest of `chosen_part`."""
    return digest.of_value(chosen_part(application))


def _read(
    stage: Stage, model: type[Strict], values: Mapping[str, Any], inherited: frozenset[Stage] | None
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        if name not in values:  # what a later version added, and is not set
            continue
        stages, value = _declared(field, inherited), values[name]
        below = _model(part(field.annotation)[0])
        if below is not None and value is not None:
            value = _read(stage, below, value, stages)
            if value or stage in (stages or NOTHING):
                found[name] = value
        elif stage in (stages or NOTHING):
            found[name] = value
    return found


def _declared(field: FieldInfo, inherited: frozenset[Stage] | None) -> frozenset[Stage] | None:
    return next((one.stages for one in field.metadata if isinstance(one, Affects)), inherited)


def _model(kind: Any) -> type[Strict] | None:
    return kind if isinstance(kind, type) and issubclass(kind, Strict) else None
