"""Recompute the menu for other limits or another alpha, and render it as text."""

from dataclasses import dataclass
from typing import Any

from fogspec.base import units
from fogspec.base.errors import OutOfDate
from fogspec.base.text import paragraph, shell_command
from fogspec.catalog.filters import filter_offers
from fogspec.charts.menu_svg import menu_chart
from fogspec.charts.terminal import plot
from fogspec.choice.choose import Choice
from fogspec.choice.menu import Entry, Menu, make_menu
from fogspec.compile.compiler import usable_results
from fogspec.compile.decision import select, warnings_for
from fogspec.compile.inputs import Inputs
from fogspec.report.summary import billing_text, entry_text, infeasible_text
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


def menu_view(inputs: Inputs, alpha: float | None, latency: str | None, cost: str | None) -> MenuView:
    """Return the menu of a measured application under other limits.

    Raise OutOfDate if it has no current results, DiagnosticError for damaged results, UnitError for a wrong quantity.
    """
    layout = inputs.layout
    results, stale = usable_results(inputs)
    if results is None:
        what = "was not measured yet" if stale is None else "has changed since it was measured"
        raise OutOfDate(f"{layout.name} {what}: there is no menu", shell_command("fogspec", "bench", layout.spec))
    application = pinned(changed(inputs.application, alpha, latency, cost), inputs.pins)
    admissible = filter_offers(inputs.catalog, application.spec.hardware, application.spec.infra)
    found = select(inputs, application, admissible, results)
    menu = make_menu(application, found.choice, warnings_for(application, found.models, found.choice, results))
    return MenuView(application, found.choice, menu)


def changed(application: Application, alpha: float | None, latency: str | None, cost: str | None) -> Application:
    """Return the application with other limits or another alpha; `none` removes a limit."""
    spec = application.spec
    limits: dict[str, Any] = {}
    if latency is not None:
        limits["latency"] = None if latency == NO_LIMIT else units.parse_duration_s(latency)
    if cost is not None:
        limits["cost"] = None if cost == NO_LIMIT else units.parse_cost_usd_per_request(cost)
    objective = spec.objective if alpha is None else spec.objective.model_copy(update={"alpha": alpha})
    constraints = spec.constraints.model_copy(update=limits)
    return application.model_copy(
        update={"spec": spec.model_copy(update={"constraints": constraints, "objective": objective})}
    )


def show(menu: Menu, picture: str = "") -> str:
    """Return the menu as text: the named choices, the chart, then the Pareto fronts."""
    body = menu.spec
    limits = ", ".join(f"{name} at most {bound}" for name, bound in body.limits.items()) or "none"
    lines = [
        f"{menu.metadata.name}: {body.objective}, {billing_text(menu)}, {body.statistic} latency",
        f"limits: {limits}; {body.meet} of {body.predicted} machines meet them",
        *(f"warning: {text}" for text in body.warnings),
    ]
    if body.balanced is None:
        lines += infeasible_text(menu)
    else:
        for role in ("balanced", "cheapest", "fastest"):
            entry: Entry | None = getattr(body, role)
            if entry is not None:
                lines.append(f"{role:<9} {entry_text(entry)}")
    fronts = ["", f"Pareto front, cost of one request against {body.statistic} latency:", *_table(body.front)]
    fronts += ["", f"Pareto front, price of an hour against {body.statistic} latency:", *_table(body.hourly_front)]
    return "\n".join([paragraph(lines), *(["", picture] if picture else []), paragraph(fronts)])


def _table(entries: list[Entry]) -> list[str]:
    rows = [("instance type", "infra", "vCPU", "memory", "price", "latency", "cost", "")]
    for e in entries:
        gpu = f" {e.gpu.count:g}x{e.gpu.name}" if e.gpu else ""
        remark = "measured" if e.measured else "extrapolated" if e.extrapolated else ""
        rows.append(
            (
                e.instance + (" spot" if e.spot else "") + gpu,
                e.infra,
                f"{e.cpus:g}",
                units.format_memory(e.memory),
                units.format_price(e.price),
                units.format_duration(e.latency),
                units.format_cost(e.cost),
                remark,
            )
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
