"""From a choice to its pictures: which machines are drawn by themselves, and what is said of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fogspec.base import units
from fogspec.base.layout import Layout
from fogspec.base.units import short_dollars
from fogspec.charts import menu_svg, model_svg
from fogspec.charts.axes import number, requests_unit, seconds
from fogspec.charts.chart import Chart, Crowd, PlottedMachine
from fogspec.charts.drawing_models import interval_of, latency_chart
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, floored, limit_text, thinned, weights
from fogspec.choice.rule import latency_limit_s
from fogspec.choice.shortlist import shortlist
from fogspec.model.fit import Models
from fogspec.spec.schema import Application

ALTERNATIVES = 2
WORDS = 92


def menu_chart(application: Application, choice: Choice, doubts: Sequence[str]) -> Chart:
    """The menu as a picture, for a choice with at least one machine that can be predicted."""
    spec = application.spec
    metric = spec.objective.metric
    rows = np.flatnonzero(choice.eligible & (choice.metric_value > 0) & (choice.cost_usd_per_request > 0))
    rate = spec.objective.rate if spec.objective.billing == "provisioned" else None
    limit = spec.constraints.metrics.get(metric) if metric else _latency_limit(application)
    return Chart(
        title=application.metadata.name, subtitle=_subtitle(application, choice),
        y_label=f"{metric} in {spec.metrics[metric].unit or 'its unit'}" if metric else f"{spec.constraints.statistic} latency",
        machines=_machines(choice, metric), y_is="number" if metric else "duration",
        crowd=Crowd(
            choice.metric_value[rows], choice.cost_usd_per_request[rows], choice.offers.price_usd_per_hour[rows],
            choice.feasible[rows],
        ),
        y_limit=limit, cost_limit_usd_per_request=spec.constraints.cost, price_limit_usd_per_hour=spec.constraints.price,
        requests_per_hour=None if rate is None else rate * 3600, level=LEVEL, notes=[*_none(choice), *doubts[:1]],
    )  # fmt: skip


def named(choice: Choice) -> dict[str, int]:
    """What is labelled: the choice and two alternatives; where nothing meets the limits, what comes nearest."""
    if choice.chosen is None:
        found = {} if choice.least_infeasible is None else {"nearest": choice.least_infeasible}
        for miss in choice.violations:
            if miss.row not in found.values():
                found[f"nearest in {miss.limit}"] = miss.row
        return dict(list(found.items())[: ALTERNATIVES + 1])
    others = [(role, row) for role, row in shortlist(choice).items()]
    return {"chosen": choice.chosen, **dict(others[:ALTERNATIVES])}


def _none(choice: Choice) -> list[str]:
    """That no machine meets the limits, and how far off the nearest is."""
    if choice.feasible.any():
        return []
    far = [f"{miss.limit} would have to be {miss.factor:.3g} times as large" for miss in choice.violations]
    either = " or " if all(miss.alone for miss in choice.violations) else " and "
    return [": ".join(["no machine meets the limits", *([either.join(far)] if far else [])])]


def _latency_limit(application: Application) -> float | None:
    objective, limit = application.spec.objective, latency_limit_s(application)
    if objective.billing == "provisioned" and objective.rate:
        return min(1 / objective.rate, limit or np.inf)
    return limit


def _subtitle(application: Application, choice: Choice) -> str:
    limits = ", ".join(f"{name} at most {limit_text(name, bound)}" for name, bound in choice.bounds.items())
    billing = "" if application.spec.objective.billing == "busy" else ", whole hours are paid"
    surely = f"; met with probability {choice.level:g}" if choice.bounds and choice.level is not None else ""
    return f"{weights(application)}{billing}; limits: {limits or 'none'}{surely}"


def _machines(choice: Choice, metric: str | None) -> list[PlottedMachine]:
    """Those that stand out, the measured ones, and the fronts."""
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
        found.append(PlottedMachine(
            name, float(choice.metric_value[row]), float(choice.cost_usd_per_request[row]),
            float(choice.offers.price_usd_per_hour[row]), low, high, measured=bool(predictions.measured[row]),
            on_front=row in fronts[0], on_hourly_front=row in fronts[1], role=roles.get(row, ""),
            words=_described(choice, row, name, metric, factor, unit) if row in roles else "",
        ))  # fmt: skip
    return found


def _measured_types(choice: Choice) -> set[int]:
    """One offer for each type that was measured: the one with the best objective."""
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
    value = f"{metric} {number(metric_value)}" if metric else seconds(metric_value)
    per = "request" if factor == 1 else unit.removeprefix("a ")
    cost = short_dollars(float(choice.cost_usd_per_request[row]) * factor)
    rest = f"{value}, {cost} per {per}, {short_dollars(machine.price)}/h"
    within = all(choice.values[limit][row] <= bound for limit, bound in choice.bounds.items())
    if within and not choice.feasible[row] and (probability := choice.probability(row)) is not None:
        rest += f"; met with probability {floored(probability):g}"
    ways = (f"{name}{shape}, {machine.infra}: {rest}", f"{name}, {machine.infra}: {rest}", f"{name}: {rest}")
    return next((words for words in ways if len(words) <= WORDS), ways[-1])


def charts(
    application: Application, choice: Choice, models: Models, doubts: Sequence[str], layout: Layout
) -> dict[Path, bytes]:
    """The pictures' files; none where nothing can be predicted."""
    if not len(choice.front):
        return {}
    found = {layout.picture: menu_svg.draw(menu_chart(application, choice, doubts)).encode()}
    chart = latency_chart(application, choice, models)
    if chart.panels:
        found[layout.latencies] = model_svg.draw(chart).encode()
    return found
