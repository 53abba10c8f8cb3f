"""Describe the menu of a choice as a chart: the machines that are drawn individually, and every text.

The title states the finding; names from files are shortened to the room that the picture has for them.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from fogspec.base.text import line
from fogspec.base.units import REQUESTS_SHOWN, REQUESTS_TEXT, money, shown_percent
from fogspec.charts.axes import number, seconds
from fogspec.charts.chart import Chart, Crowd, PlottedMachine, interval_of
from fogspec.charts.text import HEAD, LEAD, SIZE, shortened
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, NEAR, floored, thinned, usage_text
from fogspec.choice.rule import Violation, latency_limit_s
from fogspec.choice.shortlist import ruled_out, runner_up, shortlist
from fogspec.spec.schema import Application

MARKS = 60  # machines that are drawn individually
NAME = 260.0  # px that a name takes in a line of text


def menu_chart(
    application: Application, choice: Choice, doubts: Sequence[str], rows: Sequence[int] | None = None
) -> Chart:
    """Return the menu chart of a choice that has at least one predicted machine.

    `doubts` are the warnings about the choice; every chart shows all of them. `rows` are the machines to draw individually,
    otherwise those that matter.
    """
    spec = application.spec
    metric = spec.objective.metric
    drawn = _drawable(choice)
    costs = choice.rule.costs
    chart_rows = choice.eligible & drawn
    unit = spec.metrics[metric].unit if metric else None
    return Chart(
        title=title_of(choice),
        lead=_lead(choice),
        facts=facts_of(application, choice),
        rows=_rows(choice),
        source=source_of(choice),
        y_label=f"{line(metric)}{f' in {line(unit)}' if unit else ''}"
        if metric
        else f"{spec.constraints.statistic} latency",
        machines=_machines(choice, metric, rows),
        y_is="number" if metric else "duration",
        crowd=Crowd(
            choice.metric_value[chart_rows],
            choice.cost_usd_per_request[chart_rows],
            choice.offers.price_usd_per_hour[chart_rows],
            choice.feasible[chart_rows],
        ),
        y_limits=_y_limits(application),
        cost_limit_usd_per_request=spec.constraints.cost,
        price_limit_usd_per_hour=spec.constraints.price,
        requests_per_hour=costs.requests_per_s and costs.requests_per_s * 3600 * costs.used / costs.up,
        iso=_iso(choice),
        broken=choice.chosen is not None and not choice.satisfied[choice.chosen],
        level=LEVEL,
        notes=doubts,
    )


def named(choice: Choice) -> dict[str, int]:
    """Return the labelled rows by role: the choice and two alternatives, or the nearest if no machine meets the limits."""
    if choice.chosen is None:
        found = {} if choice.least_infeasible is None else {"nearest": choice.least_infeasible}
        for miss in choice.violations:
            if miss.row not in found.values():
                found[f"nearest in {miss.limit}"] = miss.row
        return dict(list(found.items())[:3])
    others = {"runner-up": runner_up(choice), "ruled out": ruled_out(choice), **shortlist(choice)}
    found = {"chosen": choice.chosen}
    for role, row in others.items():
        if row is not None and row not in found.values() and len(found) < 3:
            found[role] = row
    return found


def limits_words(choice: Choice) -> str:
    """Return the limits as a noun: `both limits`, `the latency limit`."""
    names = list(choice.bounds)
    if len(names) == 1:
        return f"the {line(names[0].removeprefix('metrics.'))} limit"
    return "both limits" if len(names) == 2 else f"all {len(names)} limits"


def _drawable(choice: Choice) -> NDArray[np.bool_]:
    """Return the machines that a logarithmic chart can show."""
    return np.asarray((choice.metric_value > 0) & (choice.cost_usd_per_request > 0))


def title_of(choice: Choice) -> str:
    """Return the finding as a sentence."""
    if choice.chosen is None:
        return _none(choice)
    row = choice.chosen
    name, limits = _name(choice, row, NAME), limits_words(choice)
    if choice.latency.posterior is None:
        return f"{name} looks best; no cloud machine was measured"
    if not choice.satisfied[row]:
        return f"{name} is the relaxed method's choice, but misses a limit"
    if not choice.meets_confidence and choice.bounds:
        return f"No machine meets {limits} with {number(100 * choice.confidence)}% probability; {name} comes closest"
    better = choice.best is not None and choice.objective[row] > choice.objective[choice.best] * (1 + 1e-9)
    measured = choice.candidates.sum() < choice.feasible.sum()
    only = bool(choice.bounds) and choice.feasible.sum() == 1
    best = (
        "the relaxed method's choice"
        if better
        else "the best measured machine"
        if measured
        else "the only machine"
        if only
        else "the best machine"
    )
    if not choice.latency.measured[row]:
        return (
            f"{name} is predicted to be the {'only machine' if only else 'best'} within {limits}"
            if choice.bounds
            else f"{name} is predicted to be {best}"
        )
    if choice.bounds:
        return f"{name} is {best} that meets {limits}"
    return f"{name} is {best.removesuffix(' machine')} of {choice.eligible.sum():,} machines"


def _none(choice: Choice) -> str:
    if choice.feasible.any():
        return "The relaxed method finds no machine, though some meet the limits"
    alone = [miss for miss in choice.violations if miss.alone]
    if len(alone) == 1:
        miss = alone[0]
        limit = shortened(line(miss.limit.removeprefix("metrics.")), 200, HEAD, bold=True)
        return f"No machine meets the {limit} limit of {_bound(choice, miss)}"
    return f"No machine meets {limits_words(choice)}" if choice.bounds else "No machine can be predicted"


def _bound(choice: Choice, miss: Violation) -> str:
    match miss.limit:
        case "latency" | "rate":
            return seconds(miss.bound)
        case "cost":
            return f"{money(miss.bound * REQUESTS_SHOWN)} per {REQUESTS_TEXT}"
        case "price":
            return f"{money(miss.bound)}/h"
        case _:
            unit = shortened(line(choice.rule.unit_of(miss.limit)), 60, HEAD)
            return f"{number(miss.bound)} {unit}".strip()


def _name(choice: Choice, row: int, room: float, size: float = HEAD) -> str:
    offers = choice.offers
    name = line(offers.instance[row]) + (" spot" if offers.spot[row] else "")
    return shortened(name, room, size, bold=True)


def _lead(choice: Choice) -> list[tuple[str, bool]]:
    """Return the line about the choice: shape, price, latency and cost, of which the last two are bold."""
    row = choice.chosen
    if row is None:
        return []
    machine = choice.offers.machine(row)
    gpu = f", {line(machine.gpu.label)}" if machine.gpu else ""
    shape = f"{machine.cpus:g} vCPU, {number(machine.memory)} GiB{gpu}"
    shape = f"{shortened(shape, 210, LEAD)} · {money(machine.price)}/h · "
    metric, how = choice.rule.metric, _how(choice, row)
    if metric:
        unit_of = line(choice.rule.units.get(metric, ""))
        value = f"{number(float(choice.metric_value[row]))} {shortened(unit_of, 40, LEAD)}".strip()
        what = [(value, True), (f" {shortened(line(metric), 120, LEAD)} ({how}) · ", False)]
    else:
        what = [(seconds(float(choice.latency.value[row])), True), (f" per request ({how}) · ", False)]
    return [
        (shape, False),
        *what,
        (money(float(choice.cost_usd_per_request[row]) * REQUESTS_SHOWN), True),
        (f" per {REQUESTS_TEXT}", False),
    ]


def _how(choice: Choice, row: int) -> str:
    metric = choice.rule.metric
    measured = (choice.metrics[metric] if metric else choice.latency).measured[row]
    return "measured" if measured else "extrapolated" if choice.latency.extrapolated[row] else "predicted"


def facts_of(application: Application, choice: Choice) -> str:
    """Return the line about the candidates and the objective."""
    machines, feasible = int(choice.eligible.sum()), int(choice.feasible.sum())
    measured = len(_measured_types(choice))
    counted = f"{machines:,} machine{'' if machines == 1 else 's'}, {measured} measured"
    if choice.bounds:
        surely = f" (P ≥ {choice.level:g})" if choice.level is not None else ""
        counted += f", {feasible:,} meet{'s' if feasible == 1 else ''} {limits_words(choice)}{surely}"
    objective = application.spec.objective
    metric = shortened(line(objective.metric or "latency"), 110)
    counted += f" · objective: {objective.alpha:.0%} {metric}, {1 - objective.alpha:.0%} cost"
    if objective.billing != "busy":
        counted += f" · {usage_text(objective.usage) or 'billed by whole hours'}"
    return counted


def _rows(choice: Choice) -> list[tuple[str, str]]:
    """Return the machines beside the choice: what they are called, their figures, and why they are not chosen."""
    found = []
    for role, row in named(choice).items():
        if role == "chosen":
            continue
        metric = choice.rule.metric
        value = float(choice.metric_value[row])
        words = f"{number(value)} {line(choice.rule.units.get(metric, ''))}".strip() if metric else seconds(value)
        cost = money(float(choice.cost_usd_per_request[row]) * REQUESTS_SHOWN)
        name = _name(choice, row, 190, SIZE)
        found.append((line(role), f"{name}: {words}, {cost} ({_how(choice, row)}); {_why_not(choice, row)}"))
    return found


def _why_not(choice: Choice, row: int) -> str:
    """Return in a few words why a machine is not chosen."""
    over = [
        f"{_times(float(choice.values[name][row]), bound)} the {line(name.removeprefix('metrics.'))} limit"
        for name, bound in choice.bounds.items()
        if not choice.values[name][row] <= bound
    ]
    if over:
        return ", ".join(over)
    if not choice.feasible[row]:
        return f"meets {limits_words(choice)} with only {floored(choice.probability(row) or 0):.1%} probability"
    if choice.chosen is None:
        return "meets the limits"
    own, best = float(choice.objective[row]), float(choice.objective[choice.chosen])
    if own < best:
        return f"objective {own:.3g} against {best:.3g} of the choice, but not measured"
    return f"objective {own:.3g}, the choice has {best:.3g}"


def _times(value: float, bound: float) -> str:
    if not math.isfinite(value):
        return "not known against"
    if bound <= 0:
        return "over"
    ratio = value / bound
    return f"{shown_percent(ratio - 1)} over" if ratio < NEAR else f"{number(ratio)} ×"


def source_of(choice: Choice, *, prices: bool = True) -> str:
    """Return where the machines come from, or their prices with their date, and what the latency leaves out."""
    about = choice.offers.about
    source = line(about.source.partition(": ")[2] or about.source)
    regions = [region for region in dict.fromkeys(map(str, choice.offers.region)) if region]
    where = line(regions[0]) if len(regions) == 1 else f"{len(regions)} regions" if regions else ""
    parts = [part for part in (shortened(source, 260), shortened(where, 140), line(about.date)) if part]
    return f"{'Prices' if prices else 'Machines'}: {', '.join(parts)}. Latency excludes the network."


def _y_limits(application: Application) -> list[tuple[str, float]]:
    spec = application.spec
    metric = spec.objective.metric
    if metric:
        bound = spec.constraints.metrics.get(metric)
        return [] if bound is None else [(shortened(line(metric), 150), bound)]
    latency, objective = latency_limit_s(application), spec.objective
    found = [] if latency is None else [("latency", latency)]
    return [*found, ("rate", 1 / objective.rate)] if objective.billing == "provisioned" and objective.rate else found


def _iso(choice: Choice) -> tuple[float, float] | None:
    """Return where the line of machines as good as the choice meets the axes of y and cost; infinite if it does not."""
    if choice.chosen is None or choice.by_relaxation:
        return None
    value, alpha = float(choice.objective[choice.chosen]), choice.rule.alpha
    if not value > 0:
        return None
    y = value * choice.scale.metric / alpha if alpha > 0 else math.inf
    return y, value * choice.scale.cost / (1 - alpha) if alpha < 1 else math.inf


def _machines(choice: Choice, metric: str | None, rows: Sequence[int] | None) -> list[PlottedMachine]:
    """Return the highlighted machines, the measured ones, the Pareto fronts, and the best others of each type."""
    roles = {row: role for role, row in reversed(named(choice).items())}
    fronts = set(thinned(choice.front)), set(thinned(choice.hourly_front))
    predictions = choice.metrics[metric] if metric else choice.latency
    wanted = _worth_drawing(choice, {*roles, *_measured_types(choice)}) if rows is None else {*roles, *rows}
    drawn = _drawable(choice)
    order = {role: at for at, role in enumerate(named(choice))}
    shown = [row for row in {*wanted, *fronts[0], *fronts[1]} if drawn[row]]
    costs = choice.rule.costs
    predictions.intervals(sorted({*shown} & wanted), LEVEL)  # all at once: each is kept
    found = []
    for row in sorted(shown, key=lambda row: (order.get(roles.get(row, ""), len(order)), row)):
        ends = interval_of(predictions, row) if row in wanted else None
        low, high = ends or (None, None)
        cost = float(choice.cost_usd_per_request[row])
        of_ends: tuple[float | None, ...] = (None, None)
        if ends is not None:
            # Only of this row: costs are columns.
            own = choice.rule.take(np.array([row])).costs if metric is None else costs
            of_ends = tuple(cost if metric else float(own.per_request(np.array([end]))[0]) for end in ends)
        found.append(
            PlottedMachine(
                name=line(choice.offers.instance[row]) + (" spot" if choice.offers.spot[row] else ""),
                y=float(choice.metric_value[row]),
                cost_usd_per_request=cost,
                price_usd_per_hour=float(choice.offers.price_usd_per_hour[row]),
                low=low,
                high=high,
                low_cost=of_ends[0],
                high_cost=of_ends[1],
                measured=bool(predictions.measured[row]),
                meets=bool(choice.feasible[row]),
                gpu=bool(choice.offers.gpu[row]),
                nested_in=predictions.where_nested(row),
                on_front=row in fronts[0],
                on_hourly_front=row in fronts[1],
                role=roles.get(row, ""),
                row=row,
            )
        )
    return found


def _worth_drawing(choice: Choice, first: Iterable[int]) -> set[int]:
    """Return `first` and then the best offer of each type, feasible ones first, until there are enough."""
    offers, found = choice.offers, set(first)
    types = {_type_of(choice, row) for row in found}
    rows = np.flatnonzero(choice.eligible)
    for row in rows[np.lexsort((choice.objective[rows], ~choice.feasible[rows]))].tolist():
        if len(found) >= MARKS:
            break
        if _type_of(choice, row) not in types:
            types.add(_type_of(choice, row))
            found.add(row)
    return found if len(offers) else set()


def _type_of(choice: Choice, row: int) -> tuple[str, str, str, bool]:
    offers = choice.offers
    return str(offers.cloud[row]), str(offers.instance[row]), str(offers.gpu[row]), bool(offers.spot[row])


def _measured_types(choice: Choice) -> set[int]:
    """Return one row for each measured instance type: the offer with the best objective."""
    best: dict[tuple[str, str, str, bool], int] = {}
    rows: NDArray[np.intp] = np.flatnonzero(choice.latency.measured & choice.eligible)
    for row in rows[np.argsort(choice.objective[rows], kind="stable")].tolist():
        best.setdefault(_type_of(choice, row), row)
    return set(best.values())
