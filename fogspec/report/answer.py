"""The answer of a report: the tiles at its top, three sentences why, and the costs of the benchmark as a bar."""

from typing import Any

from fogspec.base import units
from fogspec.base.text import line
from fogspec.base.units import REQUESTS_SHOWN, REQUESTS_TEXT, dollars, money
from fogspec.charts.axes import number, seconds
from fogspec.charts.chart import interval_of
from fogspec.charts.menu_chart import limits_words
from fogspec.choice.menu import floored
from fogspec.choice.sensitivity import Slack, slacks
from fogspec.choice.shortlist import runner_up
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.decision import Decision
from fogspec.results.schema import own_records

Tile = dict[str, Any]


def tiles(compiled: Artifacts, decision: Decision) -> list[Tile]:
    """Return the tiles of the chosen machine: machine, latency, cost, price, probability, benchmark; none without a choice."""
    choice = decision.choice
    row = choice.chosen
    if row is None:
        return []
    machine, spec = choice.offers.machine(row), compiled.application.spec
    gpu = f", {line(machine.gpu.label)}" if machine.gpu else ""
    shape = f"{machine.cpus:g} vCPU, {number(machine.memory)} GiB{gpu}, {line(machine.infra)}"
    measured = bool(choice.latency.measured[row])
    found = [_tile("machine", line(machine.instance), shape, badge="measured" if measured else "predicted")]
    latency, bound = float(choice.latency.value[row]), choice.bounds.get("latency")
    ends = interval_of(choice.latency, row)
    between = f"[{seconds(ends[0])}, {seconds(ends[1])}]; " if ends else ""
    found.append(_against(f"{spec.constraints.statistic} latency", seconds(latency), latency, bound, seconds, between))
    if metric := choice.rule.metric:
        value, unit = float(choice.metric_value[row]), line(choice.rule.units.get(metric, ""))
        words = f"{number(value)} {unit}".strip()
        found.append(_against(line(metric), words, value, choice.bounds.get(f"metrics.{metric}"), number))
    cost, most = float(choice.cost_usd_per_request[row]), choice.bounds.get("cost")
    found.append(
        _against(
            f"cost per {REQUESTS_TEXT}",
            money(cost * REQUESTS_SHOWN),
            cost,
            most,
            lambda usd: money(usd * REQUESTS_SHOWN),
        )
    )
    month = f"{money(float(choice.rule.costs.usd_per_month[row]))} per month"
    found.append(_tile("price", f"{money(machine.price)}/h", f"{month}{', spot' if machine.spot else ''}"))
    probability = choice.probability(row)
    if probability is not None and choice.bounds:
        asked = f"that {limits_words(choice)} {'is' if len(choice.bounds) == 1 else 'are'} met; {choice.confidence:g} required"
        found.append(_tile("probability", f"{floored(probability):g}", asked, probability))
    if bar := cost_bar(compiled):
        found.append(_tile("benchmark", bar["big"], bar["short"], bar["share"]))
    return found


def _tile(head: str, big: str, words: str, share: float | None = None, badge: str = "") -> Tile:
    return {"head": head, "big": big, "words": words, "share": share, "badge": badge, "kind": badge}


def _against(head: str, big: str, value: float, bound: float | None, words: Any, between: str = "") -> Tile:
    """Return a tile with a bar of a value in its limit."""
    if bound is None or bound <= 0:
        return _tile(head, big, f"{between}no limit")
    room = units.headroom_text(value, bound)
    return _tile(head, big, f"{between}limit {words(bound)}, {room}", value / bound)


def cost_bar(compiled: Artifacts) -> Tile | None:
    """Return what the benchmark spent of its plan and its budget, with the widths of a bar in percent; None if it is free."""
    body, results = compiled.plan.spec, compiled.results
    spent, planned, budget = results.spec.spent if results else 0.0, compiled.most_usd, body.budget
    total = max(spent, planned, budget or 0.0)
    if not total:
        return None
    limit = f" of {dollars(budget)}" if budget is not None else ""
    samples = own_records(results.spec.samples) if results else []
    counted = f"{len(samples)} sample{'' if len(samples) == 1 else 's'} measured"
    words = f"{dollars(spent)} spent, {dollars(planned)} planned at most" + (
        "" if budget is None else f", budget {dollars(budget)}"
    )
    return {
        "words": f"{words}.",
        "big": f"{dollars(spent)}{limit}",
        "short": f"{counted}; {dollars(planned)} planned at most",
        "share": spent / budget if budget else None,
        "spent": round(100 * spent / total, 1),
        "planned": round(100 * max(planned - spent, 0.0) / total, 1),
    }


def why(compiled: Artifacts, decision: Decision) -> list[str]:
    """Return three sentences: why this machine, how far the next best is behind, and what would change the choice."""
    choice = decision.choice
    row = choice.chosen
    if row is None:
        best = decision.menu.spec.nearest
        return (
            []
            if best is None
            else [f"{line(best.instance)} comes closest: {line(best.why_not or 'it meets the limits')}."]
        )
    name, objective = line(choice.offers.instance[row]), choice.objective
    feasible = int(choice.feasible.sum())
    pool = (
        f"the {feasible:,} machines that meet {limits_words(choice)}" if choice.bounds else f"all {feasible:,} machines"
    )
    if int(choice.candidates.sum()) < feasible:
        pool = f"the measured ones of {pool}"
    weights = compiled.application.spec.objective
    found = [
        f"{name} has the lowest objective value, {objective[row]:.3g}, of {pool}: "
        f"{number(100 * weights.alpha)}% {line(weights.metric or 'latency')}, {number(100 * (1 - weights.alpha))}% cost."
        if feasible != 1 or not choice.bounds
        else f"No other machine meets {limits_words(choice)}; {name} has the objective value {objective[row]:.3g}."
    ]
    other = runner_up(choice)
    if other is not None:
        slower = float(choice.metric_value[other] - choice.metric_value[row])
        dearer = float(choice.cost_usd_per_request[other] - choice.cost_usd_per_request[row]) * REQUESTS_SHOWN
        words = number if choice.rule.metric else seconds
        found.append(
            f"The runner-up, {line(choice.offers.instance[other])}, has {objective[other]:.3g}: {_signed(slower, words)} "
            f"{line(choice.rule.metric or 'latency')}, {_signed(dearer, money)} per {REQUESTS_TEXT}."
        )
    changes = [text for one in slacks(choice) if (text := _change(one))]
    if changes:
        found.append(f"The choice changes with {' or '.join(changes)}.")
    return found


def _signed(value: float, words: Any) -> str:
    return f"{'−' if value < 0 else '+'}{words(abs(value)) if value else words(0.0)}"


def _change(one: Slack) -> str:
    """Return the bound of a limit below which the choice changes."""
    name = line(one.limit.removeprefix("metrics."))
    if one.limit in ("latency", "rate"):
        return f"a {name} limit below {seconds(one.required)}"
    if one.limit == "cost":
        return f"a cost limit below {money(one.required * REQUESTS_SHOWN)} per {REQUESTS_TEXT}"
    if one.limit == "price":
        return f"a price limit below {money(one.required)}/h"
    return f"a limit on {name} below {units.shown(one.required)} {line(one.unit)}".rstrip()
