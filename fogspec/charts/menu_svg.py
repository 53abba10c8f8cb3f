"""Draw the menu as SVG: latency against cost per request and price per hour, Pareto staircases and limits.

`menu_chart` selects the machines that are drawn individually and their texts; `draw` renders the SVG.
"""

import textwrap
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fogspec.base import units
from fogspec.base.templates import render
from fogspec.base.units import short_dollars
from fogspec.charts.axes import CHARACTER, number, requests_unit, seconds
from fogspec.charts.chart import (
    Chart,
    Crowd,
    Floats,
    PlottedMachine,
    View,
    interval_of,
    per_hour,
    per_request,
    y_axis,
    y_words,
)
from fogspec.charts.frame import Dot, Frame, frame, place_labels
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, floored, limit_text, thinned, usage_text, weights
from fogspec.choice.rule import latency_limit_s
from fogspec.choice.shortlist import shortlist
from fogspec.spec.schema import Application

ALTERNATIVES = 2
WORDS = 92
WIDTH, LEFT, RIGHT = 760, 84, 18
TOP, FRAME_HEIGHT, GAP = 62, 238, 72
ROW = 20
FINE, COARSE, MANY = 2, 4, 3000


def menu_chart(application: Application, choice: Choice, doubts: Sequence[str]) -> Chart:
    """Return the menu chart of a choice that has at least one predicted machine."""
    spec = application.spec
    metric = spec.objective.metric
    rows = np.flatnonzero(choice.eligible & (choice.metric_value > 0) & (choice.cost_usd_per_request > 0))
    costs = choice.rule.costs
    limit = spec.constraints.metrics.get(metric) if metric else _latency_limit(application)
    return Chart(
        title=application.metadata.name,
        subtitle=_subtitle(application, choice),
        y_label=f"{metric} in {spec.metrics[metric].unit or 'its unit'}"
        if metric
        else f"{spec.constraints.statistic} latency",
        machines=_machines(choice, metric),
        y_is="number" if metric else "duration",
        crowd=Crowd(
            choice.metric_value[rows],
            choice.cost_usd_per_request[rows],
            choice.offers.price_usd_per_hour[rows],
            choice.feasible[rows],
        ),
        y_limit=limit,
        cost_limit_usd_per_request=spec.constraints.cost,
        price_limit_usd_per_hour=spec.constraints.price,
        requests_per_hour=costs.requests_per_s and costs.requests_per_s * 3600 * costs.used / costs.up,
        level=LEVEL,
        notes=[*_none(choice), *doubts[:1]],
    )


def named(choice: Choice) -> dict[str, int]:
    """Return the labelled rows by role: the choice and two alternatives, or the nearest if no machine meets the limits."""
    if choice.chosen is None:
        found = {} if choice.least_infeasible is None else {"nearest": choice.least_infeasible}
        for miss in choice.violations:
            if miss.row not in found.values():
                found[f"nearest in {miss.limit}"] = miss.row
        return dict(list(found.items())[: ALTERNATIVES + 1])
    others = [(role, row) for role, row in shortlist(choice).items()]
    return {"chosen": choice.chosen, **dict(others[:ALTERNATIVES])}


def _none(choice: Choice) -> list[str]:
    """Return a note that no machine meets the limits and how far the nearest is off; no note if one does."""
    if choice.feasible.any():
        return []
    far = [f"{miss.limit}: the best machine needs {miss.factor:.3g} times the limit" for miss in choice.violations]
    either = " or " if all(miss.alone for miss in choice.violations) else " and "
    return [": ".join(["no machine meets the limits", *([either.join(far)] if far else [])])]


def _latency_limit(application: Application) -> float | None:
    objective, limit = application.spec.objective, latency_limit_s(application)
    if objective.billing == "provisioned" and objective.rate:
        return min(1 / objective.rate, limit or np.inf)
    return limit


def _subtitle(application: Application, choice: Choice) -> str:
    limits = ", ".join(
        f"{name} at most {limit_text(name, bound, choice.rule.unit_of(name))}" for name, bound in choice.bounds.items()
    )
    objective = application.spec.objective
    billing = "" if objective.billing == "busy" else f", {usage_text(objective.usage) or 'whole hours are paid'}"
    surely = f"; met with probability {choice.level:g}" if choice.bounds and choice.level is not None else ""
    return f"{weights(application)}{billing}; limits: {limits or 'none'}{surely}"


def _machines(choice: Choice, metric: str | None) -> list[PlottedMachine]:
    """Return the highlighted machines, the measured ones, and the Pareto fronts."""
    roles = {row: role for role, row in reversed(named(choice).items())}
    fronts = set(thinned(choice.front)), set(thinned(choice.hourly_front))
    measured = _measured_types(choice)
    predictions = choice.metrics[metric] if metric else choice.latency
    rows = [
        row
        for row in {*roles, *measured, *fronts[0], *fronts[1]}
        if choice.metric_value[row] > 0 and choice.cost_usd_per_request[row] > 0
    ]
    factor, unit = requests_unit([float(choice.cost_usd_per_request[row]) for row in rows] or [1.0])
    order = {role: at for at, role in enumerate(named(choice))}
    found = []
    for row in sorted(rows, key=lambda row: (order.get(roles.get(row, ""), len(order)), row)):
        shown = row in roles or row in measured
        low, high = (interval_of(predictions, row) if shown else None) or (None, None)
        name = str(choice.offers.instance[row]) + (" spot" if choice.offers.spot[row] else "")
        found.append(
            PlottedMachine(
                name=name,
                y=float(choice.metric_value[row]),
                cost_usd_per_request=float(choice.cost_usd_per_request[row]),
                price_usd_per_hour=float(choice.offers.price_usd_per_hour[row]),
                low=low,
                high=high,
                measured=bool(predictions.measured[row]),
                nested_in=predictions.where_nested(row),
                on_front=row in fronts[0],
                on_hourly_front=row in fronts[1],
                role=roles.get(row, ""),
                words=_described(choice=choice, row=row, name=name, metric=metric, factor=factor, unit=unit)
                if row in roles
                else "",
            )
        )
    return found


def _measured_types(choice: Choice) -> set[int]:
    """Return one row for each measured instance type: the offer with the best objective."""
    best: dict[tuple[str, str, str], int] = {}
    rows: NDArray[np.intp] = np.flatnonzero(choice.latency.measured & choice.eligible)
    offers = choice.offers
    for row in rows[np.argsort(choice.objective[rows], kind="stable")].tolist():
        best.setdefault((str(offers.cloud[row]), str(offers.instance[row]), str(offers.gpu[row])), row)
    return set(best.values())


def _described(choice: Choice, row: int, name: str, metric: str | None, factor: float, unit: str) -> str:
    machine = choice.offers.machine(row)
    gpu = f" {machine.gpu.label}" if machine.gpu else ""
    shape = f", {machine.cpus:g} vCPU {units.format_number(machine.memory)} GiB{gpu}"
    metric_value = float(choice.metric_value[row])
    unit_of_metric = choice.rule.units.get(metric, "") if metric else ""
    value = f"{metric} {number(metric_value)} {unit_of_metric}".rstrip() if metric else seconds(metric_value)
    per = "request" if factor == 1 else unit.removeprefix("a ")
    cost = short_dollars(float(choice.cost_usd_per_request[row]) * factor)
    rest = f"{value}, {cost} per {per}, {short_dollars(machine.price)}/h"
    within = all(choice.values[limit][row] <= bound for limit, bound in choice.bounds.items())
    if within and not choice.feasible[row] and (probability := choice.probability(row)) is not None:
        rest += f"; met with probability {floored(probability):g}"
    ways = (f"{name}{shape}, {machine.infra}: {rest}", f"{name}, {machine.infra}: {rest}", f"{name}: {rest}")
    return next((words for words in ways if len(words) <= WORDS), ways[-1])


def draw(chart: Chart) -> str:
    """Return the chart as SVG text. Raise ValueError if there is no machine to draw."""
    if not chart.machines and not len(chart.crowd.y):
        raise ValueError("a menu without machines cannot be drawn")
    named = [machine for machine in chart.machines if machine.role]
    subtitle = textwrap.wrap(chart.subtitle, 108)[:3]
    rows_at = TOP + 17 * (len(subtitle) - 1)
    top = rows_at + ROW * len(named) + 34
    second = top + FRAME_HEIGHT + GAP
    bottom = second + FRAME_HEIGHT
    notes = [line for note in chart.notes for line in textwrap.wrap(note, 112)][:3]
    return render(
        "picture.svg.j2",
        title=chart.title,
        subtitle=subtitle,
        summary=_summary(chart),
        width=WIDTH,
        height=bottom + 88 + 15 * len(notes),
        left=18,
        rows=[(rows_at + 14 + ROW * i, m.role, m.words) for i, m in enumerate(named)],
        words_left=18 + max([86.0, *(CHARACTER * len(m.role) + 14 for m in named)]),
        frames=[_frame(chart, per_request(chart), top), _frame(chart, per_hour(chart), second)],
        legend=_legend(chart),
        legend_y=bottom + 66,
        notes=notes,
    )


def _frame(chart: Chart, view: View, top: float) -> Frame:
    words = y_words(chart)
    found = frame(
        x=view.x_axis(chart, LEFT, WIDTH - RIGHT),
        y=y_axis(chart, top + FRAME_HEIGHT, top),
        x_label=f"{view.x_label} (log scale)",
        y_label=f"{chart.y_label} (log scale)",
        x_words=view.x_words,
        y_words=words,
        heading=view.heading,
    )
    for a, b, limit in view.forbidden:
        found.forbid(a, b, limit)
    found.specks = _specks(found, view.column(chart), chart.crowd)
    ordered = sorted(chart.machines, key=lambda m: (_rank(m, view), getattr(m, view.x), m.y, m.name))
    dots = [(machine, _dot(found, machine, view, words)) for machine in ordered]
    found.dots = [dot for _, dot in dots]
    front = view.steps(chart)
    if front:
        found.lines.insert(0, ("stairs", _staircase(found, front)))
    named = sorted(
        (one for one in dots if one[0].role), key=lambda one: (one[0].role != "chosen", one[0].role, one[0].name)
    )
    labels = [(dot, f"{m.role}: {m.name}", "chosen" if m.role == "chosen" else "named") for m, dot in named]
    place_labels(found, labels, _levels(found, front))
    return found


def _levels(found: Frame, front: Sequence[tuple[float, float]]) -> list[tuple[float, float, float, float]]:
    """Return boxes around the horizontal segments of the staircase, which labels should avoid."""
    corners = [(found.x.at(x), found.y.at(y)) for x, y in front]
    return [(x, y - 1, end, y + 1) for (x, y), (end, _) in pairwise([*corners, (found.x.end, 0.0)])]


def _rank(machine: PlottedMachine, view: View) -> int:
    """Return the drawing order; a machine of higher rank covers the others."""
    return 3 if machine.role == "chosen" else 2 if machine.role else 1 if getattr(machine, view.front) else 0


def _dot(found: Frame, machine: PlottedMachine, view: View, words: Callable[[float], str]) -> Dot:
    front = getattr(machine, view.front)
    kind = (
        "chosen" if machine.role == "chosen" else "measured" if machine.measured else "front" if front else "predicted"
    )
    bar = (found.y.clipped(machine.low), found.y.clipped(machine.high)) if machine.low and machine.high else None
    title = (
        f"{machine.name}: {words(machine.y)}, {short_dollars(machine.cost_usd_per_request)} per request, "
        f"{short_dollars(machine.price_usd_per_hour)} per hour"
        + (
            ", measured"
            if machine.measured
            else ""
            if machine.nested_in is None
            else f", measured on {machine.nested_in}"
        )
    )
    return Dot(
        x=found.x.at(getattr(machine, view.x)),
        y=found.y.at(machine.y),
        kind=kind,
        radius=6.5 if kind == "chosen" else 4.2,
        title=title,
        bar=bar,
    )


def _specks(found: Frame, column: Floats, crowd: Crowd) -> list[tuple[str, str]]:
    """Return all machines as faint points; machines that would coincide are drawn once."""
    cells: dict[int, list[int]] = {}
    grain = FINE
    for grain in (FINE, COARSE):
        px, py = (
            np.rint((axis.start + (np.log10(v) - axis.low) / (axis.high - axis.low) * (axis.end - axis.start)) / grain)
            for v, axis in ((column, found.x), (crowd.y, found.y))
        )
        key = np.unique((crowd.meets * 4096 + px.astype(np.int64)) * 4096 + py.astype(np.int64))
        cells = {meets: key[key // 4096**2 == meets].tolist() for meets in (0, 1)}
        if len(key) <= MANY:
            break
    return [
        (kind, "".join(f"M{cell // 4096 % 4096 * grain} {cell % 4096 * grain}h0" for cell in cells[meets]))
        for meets, kind in ((0, "out"), (1, "in"))
        if cells[meets]
    ]


def _staircase(found: Frame, front: Sequence[tuple[float, float]]) -> str:
    path: list[str] = []
    for x, y in front:
        px, py = found.x.at(x), found.y.at(y)
        path.append(f"H{px:g}V{py:g}" if path else f"M{px:g} {found.y.end:g}V{py:g}")
    return "".join([*path, f"H{found.x.end:g}"])


def _legend(chart: Chart) -> list[tuple[str, str]]:
    found = [("measured", "measured")] if any(m.measured for m in chart.machines) else []
    if any(m.on_front or m.on_hourly_front for m in chart.machines):
        found.append(("front", "Pareto front"))
    if any(m.low for m in chart.machines):
        found.append(("bar", f"{chart.level:.0%} interval"))
    limited = any(bool(view.forbidden) for view in (per_request(chart), per_hour(chart)))
    if bool(chart.crowd.meets.any()):
        found.append(("in", "meets the limits" if limited else "any other machine"))
    if not bool(chart.crowd.meets.all()):
        found += [("out", "does not"), ("no", "over a limit")]
    return found


def _summary(chart: Chart) -> str:
    count = len(chart.crowd.y)
    machines = "1 machine" if count == 1 else f"{count:,} machines"
    chosen = next((m for m in chart.machines if m.role == "chosen"), None)
    if chosen is None:
        return f"{machines}, none is chosen"
    return (
        f"{machines}; chosen: {chosen.name}, {y_words(chart)(chosen.y)}, {short_dollars(chosen.cost_usd_per_request)} "
        f"per request, {short_dollars(chosen.price_usd_per_hour)} per hour"
    )
