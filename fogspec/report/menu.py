"""Recompute the menu for other limits or another alpha, and render it as text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fogspec.base import units
from fogspec.base.errors import NotMeasured, OutOfDate, UsageError
from fogspec.base.text import count, paragraph, shell_command
from fogspec.catalog.filters import offers_for
from fogspec.choice.choose import Choice
from fogspec.choice.menu import Entry, Menu, entry_of, make_menu, shown_text
from fogspec.choice.shortlist import shortlist
from fogspec.compile.compiler import plan_for, standing_of, usable
from fogspec.compile.decision import outlook_after, select, warnings_for
from fogspec.compile.inputs import Inputs
from fogspec.language.lockfile import pinned
from fogspec.language.schema import Application
from fogspec.report.facts import baseline_of, machines, meeting
from fogspec.report.summary import billing_text, infeasible_text, warning_lines
from fogspec.results.progress import unfinished

NO_LIMIT = "none"
MEETING, MISSING = 5, 2  # machines of the table that meet the limits, and that do not


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """Another alpha, metric and limits, as the command line has them; None leaves what the spec says.

    `latency` and `cost` are quantities or `none`; `metric` is the name of a metric, or `latency`; `limits` are bounds of
    metrics by name, None for no bound.
    """

    alpha: float | None = None
    latency: str | None = None
    cost: str | None = None
    metric: str | None = None
    limits: Mapping[str, float | None] = field(default_factory=dict)

    def text(self) -> str:
        """Return the fields of the spec that say the same, such as `constraints.latency: 3s`; none is no such field."""
        named = {
            "objective.alpha": None if self.alpha is None else units.format_number(self.alpha),
            "objective.metric": self.metric,
            "constraints.latency": self.latency,
            "constraints.cost": self.cost,
        }
        for name, bound in self.limits.items():
            named[f"constraints.metrics.{name}"] = NO_LIMIT if bound is None else units.format_number(bound)
        return ", ".join(f"{name}: {value}" for name, value in named.items() if value is not None)


def menu_view(inputs: Inputs, changes: Changes) -> tuple[Menu, list[Entry]]:
    """Return the menu of a measured application under other limits, and the machines of its table.

    Raise NotMeasured if it has no results, OutOfDate if they are stale, DiagnosticError for damaged results, UnitError for
    a wrong quantity, UsageError for a metric that the spec does not have.
    """
    layout = inputs.layout
    standing = standing_of(inputs)
    results, stale = usable(inputs, standing)
    if results is None:
        bench = shell_command("fogspec", "bench", layout.spec)
        if stale is None:
            raise NotMeasured(f"{layout.name} was not measured yet: there is no menu", bench)
        raise OutOfDate(f"{layout.name} has changed since it was measured: there is no menu", bench)
    application = pinned(changed(inputs.application, changes), inputs.pins)
    admissible = offers_for(inputs.catalog, application.spec)
    found = select(inputs, application, admissible, results)
    measured = inputs.measured
    if inputs.base is not None:
        admissible = offers_for(measured.catalog, measured.application.spec)
    plan = plan_for(measured, admissible, results)
    left = unfinished(measured.application, plan, results)
    waived = () if standing is None else standing.waived
    warnings = warnings_for(application, found.models, found.choice, results, left, waived)
    outlook = outlook_after(application, found, results, plan)
    return make_menu(application, found.choice, warnings, outlook=outlook), listed(found.choice)


def changed(application: Application, changes: Changes) -> Application:
    """Return the application with these changes; errors as of `menu_view`."""
    spec = application.spec
    named = [*changes.limits, *([changes.metric] if changes.metric not in (None, "latency") else [])]
    if unknown := sorted(set(named) - spec.metrics.keys()):
        has = ", ".join(sorted(spec.metrics)) or "none"
        raise UsageError(f"{application.name} has no metric named {unknown[0]}; spec.metrics: {has}")
    limits: dict[str, Any] = {}
    if changes.latency is not None:
        limits["latency"] = None if changes.latency == NO_LIMIT else units.parse_duration_s(changes.latency)
    if changes.cost is not None:
        limits["cost"] = None if changes.cost == NO_LIMIT else units.parse_cost_usd_per_request(changes.cost)
    bounds = {**spec.constraints.metrics, **changes.limits}
    limits["metrics"] = {name: bound for name, bound in bounds.items() if bound is not None}
    objective: dict[str, Any] = {} if changes.alpha is None else {"alpha": changes.alpha}
    if changes.metric is not None:
        objective["metric"] = None if changes.metric == "latency" else changes.metric
    return application.model_copy(
        update={
            "spec": spec.model_copy(
                update={
                    "constraints": spec.constraints.model_copy(update=limits),
                    "objective": spec.objective.model_copy(update=objective),
                }
            )
        }
    )


def show(menu: Menu, entries: Sequence[Entry], width: int = 80) -> str:
    """Return the menu as text, its table at most `width` wide: the machines of the table, then what bears on the choice."""
    body, places = menu.spec, {entry.infra for entry in entries}
    limits = ", ".join(f"{name} at most {shown_text(name, bound)}" for name, bound in body.limits.items()) or "none"
    lines = [
        f"{menu.metadata.name}: {body.objective}, {billing_text(menu)}, {body.statistic} latency",
        f"limits: {limits}; {meeting(menu).replace('the limits', 'them')}{f' in {places.pop()}' if len(places) == 1 else ''}",
    ]
    if body.balanced is None:
        lines += infeasible_text(menu)
    if words := baseline_of(menu):
        lines.append(f"baseline: {words}")
    lines += machines(menu, entries).text(width)
    named = warning_lines(body.warnings)
    hidden = len(body.warnings) - len(named)
    more = [f"  {count(hidden, 'note')} on models: {shell_command('fogspec', 'explain', menu.metadata.name)}"]
    return paragraph([*lines, *named, *(more if hidden else [])])


def listed(choice: Choice) -> list[Entry]:
    """Return the machines of the menu's table: the best that meet the limits, the named ones, then the best of the others."""
    rows = np.flatnonzero(choice.eligible & np.isfinite(choice.objective)).tolist()
    best = sorted(rows, key=lambda row: (not choice.feasible[row], choice.objective[row], row))
    met = [row for row in best if choice.feasible[row]]
    named = [choice.chosen, choice.least_infeasible, *shortlist(choice).values()]
    shown = {*met[:MEETING], *named, *best[len(met) :][:MISSING]}
    return [entry_of(choice, row) for row in best if row in shown]
