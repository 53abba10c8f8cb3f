"""Render a status as text and as JSON."""

from collections.abc import Sequence
from typing import Any

from fogspec.base.units import dollars
from fogspec.catalog.table import in_its_unit
from fogspec.check.audit import Stage, Status
from fogspec.compile.manifest import scope_of
from fogspec.language.schema import Waiver
from fogspec.results.standing import ways_to_keep


@in_its_unit
def as_lines(one: Status, running: Sequence[str] = ()) -> list[str]:
    """Return the status as lines of text, each stage with its reasons; `running` are lines about the deployment."""
    lines = [one.layout.name]
    for stage in one.stages:
        lines.append(f"  {stage.name:<9} {stage.state:<8} {stage.path}")
        scope = scope_of(one.inputs.application) if stage.name == "manifest" and stage.state == "fresh" else None
        lines += [f"  {'':<9} {'':<8} {text}" for text in (*stage.reasons, *stage.notes, scope) if text is not None]
    if one.artifacts is not None and one.artifacts.standing is not None:
        lines += [f"  {text}" for text in ways_to_keep(one.artifacts.standing, one.layout.spec)]
    if one.refused is not None:
        lines.append(f"  cannot be compiled: {one.refused}")
    budget = "" if one.budget_usd is None else f" of a budget of {dollars(one.budget_usd)}"
    spent = "unknown" if one.spent_usd is None else dollars(one.spent_usd)
    lines.append(f"  {'spent':<9} {spent}{budget}")
    return [*lines, *running]


@in_its_unit
def as_row(one: Status) -> tuple[str, str]:
    """Return the status in two cells: the first stage that is not fresh, or that nothing is measured, and what was spent."""
    stage = next((stage for stage in one.stages if stage.state != "fresh"), None)
    measured = any(stage.name == "results" and stage.state != "missing" for stage in one.stages)
    behind = "fresh" if stage is None else f"{stage.name} {stage.state}" if measured else "not measured"
    state = "cannot be compiled" if one.refused else behind
    return state, "unknown" if one.spent_usd is None else dollars(one.spent_usd)


def _suggested(one: Status) -> Sequence[Waiver]:
    found = None if one.artifacts is None else one.artifacts.standing
    return () if found is None else found.suggested


def stage_data(stage: Stage) -> dict[str, Any]:
    """Return a stage as a dict for JSON."""
    return {
        "name": stage.name,
        "path": str(stage.path),
        "state": stage.state,
        "reasons": list(stage.reasons),
        "notes": list(stage.notes),
    }


def as_dict(one: Status) -> dict[str, Any]:
    """Return the status as a dict for JSON."""
    return {
        "name": one.layout.name,
        "stages": list(map(stage_data, one.stages)),
        "refused": one.refused,
        "waivers": [waiver.model_dump(mode="json") for waiver in _suggested(one)],
        "to_measure": one.to_measure,
        "spent_usd": one.spent_usd,
        "budget_usd": one.budget_usd,
    }
