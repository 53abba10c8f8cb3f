"""Recompute the menu for other limits or another alpha, and render it as text."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fogspec.base import units
from fogspec.base.errors import NotMeasured, OutOfDate, UsageError
from fogspec.base.text import count, line, paragraph, shell_command, table
from fogspec.catalog.filters import filter_offers
from fogspec.charts.menu_chart import menu_chart
from fogspec.charts.terminal import plot
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, Entry, Menu, MenuBody, make_menu, metric_text, shown_text
from fogspec.compile.compiler import plan_for, standing_of, usable
from fogspec.compile.decision import select, warnings_for
from fogspec.compile.inputs import Inputs
from fogspec.report.summary import billing_text, entry_text, infeasible_text
from fogspec.results.progress import unfinished
from fogspec.spec.lockfile import pinned
from fogspec.spec.schema import Application

NO_LIMIT = "none"


@dataclass(frozen=True, slots=True)
class MenuView:
    """A menu and the choice behind it."""

    application: Application
    choice: Choice
    menu: Menu

    def plot(self, width: int, color: bool) -> str:
        """Return the menu chart in plain characters; an empty string if no machine can be predicted."""
        if not len(self.choice.front):
            return ""
        return "\n".join(plot(menu_chart(self.application, self.choice, []), width, color))


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


def menu_view(inputs: Inputs, changes: Changes) -> MenuView:
    """Return the menu of a measured application under other limits.

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
    admissible = filter_offers(inputs.catalog, application.spec.hardware, application.spec.infra)
    found = select(inputs, application, admissible, results)
    measured = inputs.measured
    if inputs.base is not None:
        admissible = filter_offers(
            measured.catalog, measured.application.spec.hardware, measured.application.spec.infra
        )
    left = unfinished(measured.application, plan_for(measured, admissible, results), results)
    waived = () if standing is None else standing.waived
    warnings = warnings_for(application, found.models, found.choice, results, left, waived)
    menu = make_menu(application, found.choice, warnings)
    return MenuView(application, found.choice, menu)


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


def show(menu: Menu, picture: str = "", width: int = 80) -> str:
    """Return the menu as text, tables at most `width` wide: the named choices, the chart, then the Pareto fronts."""
    body = menu.spec
    limits = ", ".join(f"{name} at most {shown_text(name, bound)}" for name, bound in body.limits.items()) or "none"
    against = _against(body)
    lines = [
        f"{menu.metadata.name}: {body.objective}, {billing_text(menu)}, {body.statistic} latency",
        f"limits: {limits}; {_meet(body)}",
        *(f"warning: {text}" for text in body.warnings),
    ]
    if body.balanced is None:
        lines += infeasible_text(menu)
    else:
        for role, entry in (
            ("balanced", body.balanced),
            ("cheapest", body.cheapest),
            ("fastest", body.fastest),
            (f"least {body.metric}", body.least),
        ):
            if entry is not None:
                lines.append(f"{role:<9} {entry_text(entry)}")
    places = {entry.infra for entry in (*body.front, *body.hourly_front)}
    where = f" in {min(places)}" if len(places) == 1 else ""
    fronts = list[str]()
    for money, entries in (("cost per request", body.front), ("price per hour", body.hourly_front)):
        fronts += ["", f"Pareto front{where}, {money} against {against}:"]
        fronts += _table(entries, width, place=not where)
    return "\n".join([paragraph(lines), *(["", picture] if picture else []), paragraph(fronts)])


def _meet(body: MenuBody) -> str:
    return f"{body.meet} of {count(body.predicted, 'machine')} {'meets' if body.meet == 1 else 'meet'} them"


def _against(body: MenuBody) -> str:
    """Return what the fronts weigh against money: the latency, or the objective's metric with its unit."""
    if body.metric is None:
        return f"{body.statistic} latency"
    unit = next(
        (e.metrics[body.metric].unit for e in (*body.front, *body.hourly_front) if body.metric in e.metrics), None
    )
    return f"{body.metric} in {unit}" if unit else body.metric


def _table(entries: list[Entry], width: int, place: bool) -> list[str]:
    metrics = list(dict.fromkeys(name for e in entries for name in e.metrics))
    heads = [f"{name} [{LEVEL:.0%}]" + _limit_of(entries, name) for name in metrics]
    places = ["infra"] if place else []
    rows = [["instance type", *places, "vCPU", "GiB", "price", "latency", *heads, f"per {units.REQUESTS_TEXT}", ""]]
    for e in entries:
        gpu = f" {e.gpu.count:g}x{e.gpu.name}" if e.gpu else ""
        rows.append(
            [
                e.instance + (" spot" if e.spot else "") + gpu,
                *([e.infra] if place else []),
                f"{e.cpus:g}",
                units.shown(e.memory),
                units.shown_price(e.price),
                units.shown_duration(e.latency),
                *(metric_text("", e.metrics[name]).strip() if name in e.metrics else "-" for name in metrics),
                units.money(units.REQUESTS_SHOWN * e.cost),
                e.how,
            ]
        )
    return table([[line(cell) for cell in row] for row in rows], width)


def _limit_of(entries: list[Entry], name: str) -> str:
    limit = next((e.metrics[name].limit for e in entries if name in e.metrics), None)
    return "" if limit is None else f" <= {units.format_number(limit)}"
