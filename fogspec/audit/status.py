"""Render a status as text and as JSON."""

from collections.abc import Sequence
from typing import Any

from fogspec.audit.freshness import Status
from fogspec.base.units import dollars
from fogspec.results.standing import ways_to_keep
from fogspec.spec.schema import Waiver


def as_lines(one: Status, running: Sequence[str] = ()) -> list[str]:
    """Return the status as lines of text, each stage with its reasons; `running` are lines about the deployment."""
    lines = [one.layout.name]
    for stage in one.stages:
        lines.append(f"  {stage.name:<9} {stage.state:<8} {stage.path}")
        lines += [f"  {'':<9} {'':<8} {text}" for text in (*stage.reasons, *stage.notes)]
    if one.artifacts is not None and one.artifacts.standing is not None:
        lines += [f"  {text}" for text in ways_to_keep(one.artifacts.standing, one.layout.spec)]
    if one.refused is not None:
        lines.append(f"  cannot be compiled: {one.refused}")
    budget = "" if one.budget_usd is None else f" of a budget of {dollars(one.budget_usd)}"
    spent = "unknown" if one.spent_usd is None else dollars(one.spent_usd)
    lines.append(f"  {'spent':<9} {spent}{budget}")
    return [*lines, *running]


def _suggested(one: Status) -> Sequence[Waiver]:
    found = None if one.artifacts is None else one.artifacts.standing
    return () if found is None else found.suggested


def as_dict(one: Status) -> dict[str, Any]:
    """Return the status as a dict for JSON."""
    return {
        "name": one.layout.name,
        "stages": [
            {
                "name": stage.name,
                "path": str(stage.path),
                "state": stage.state,
                "reasons": list(stage.reasons),
                "notes": list(stage.notes),
            }
            for stage in one.stages
        ],
        "refused": one.refused,
        "waivers": [waiver.model_dump(mode="json") for waiver in _suggested(one)],
        "to_measure": one.to_measure,
        "spent_usd": one.spent_usd,
        "budget_usd": one.budget_usd,
    }
