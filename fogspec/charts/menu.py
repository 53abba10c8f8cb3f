"""The picture of a menu: latency, or the objective's metric, against cost, with the limits and the machines around them.

The title states the finding; names from files are shortened to the room that the picture has for them.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fogspec.base.text import count, line
from fogspec.base.units import REQUESTS_SHOWN, REQUESTS_TEXT, money, shown, shown_limit
from fogspec.charts.picture import Axis, Dot, Frame, Limit, picture
from fogspec.charts.text import LARGE, seconds, shortened
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, entry_of, thinned, usage_text, weights
from fogspec.choice.shortlist import reason, ruled_out, runner_up, shortlist
from fogspec.language.schema import Application
from fogspec.model.predict import Predictions

Floats = NDArray[np.float64]

MARKS = 30  # most machines with a mark; if there are more, those without a role are specks, and few have an interval
# An axis shows machines up to so many times its limit, else so many times the choice, and always a little more than that.
BEYOND, AROUND, BESIDE = 2.1, 4.0, 1.15
FAR, OFF = 1.6, 10.0  # a limit above so many times the last machine, or below the first divided by that, is off scale


def interval_of(predictions: Predictions, row: int) -> tuple[float, float] | None:
    """Return the interval to draw; None if the model predicts none."""
    found = predictions.interval(row, LEVEL)
    return None if found is None or not (found[0] > 0 and math.isfinite(found[1])) else found


def menu_picture(application: Application, choice: Choice, doubts: Sequence[str]) -> str | None:
    """Return the picture with `doubts`, the warnings about the choice; None if no machine has a cost to draw it at."""
    frame = menu_frame(application, choice)
    if frame is None:
        return None
    return picture(
        title_of(choice),
        [frame],
        lead=_lead(choice),
        facts=facts_of(application, choice),
        table=_table(choice),
        source=source_of(choice),
        notes=doubts,
        hue="ink" if choice.chosen is None or choice.satisfied[choice.chosen] else "broken",
    )


def menu_frame(application: Application, choice: Choice) -> Frame | None:
    """Return the machines around the limits and the choice, those that matter with marks; None if there is none to draw."""
    metric, x, y = choice.rule.metric, choice.cost_usd_per_request, choice.metric_value
    drawn = choice.eligible & (y > 0) & (x > 0)  # a logarithmic axis shows no other
    if not drawn.any():
        return None
    predictions, words = (choice.metrics[metric], shown) if metric else (choice.latency, seconds)
    named = named_of(choice)
    rows = _marked(choice, drawn, list(named.values()))
    several = int(drawn.sum()) > MARKS
    bars = {
        row: ends
        for row in rows
        if not several or predictions.measured[row] or row in named.values()
        if (ends := interval_of(predictions, row))
    }
    limits = _limits(choice)
    kept = [row for role, row in named.items() if role in ("chosen", "nearest") and drawn[row]]
    near = [end for row in kept for end in bars.get(row, ()) if y[row] / 2 < end < 2 * y[row]]
    most = [min((10**one.most for one in limits if (one.a, one.b) == of), default=math.inf) for of in ((1, 0), (0, 1))]
    last = [_end(column[kept], limit) for column, limit in zip((x, y), most, strict=True)]
    seen = drawn & (x <= last[0]) & (y <= last[1])
    seen = seen if seen.any() else drawn
    shown_x, shown_y = (_with(column[seen].tolist(), limit) for column, limit in zip((x, y), most, strict=True))
    unit = line(choice.rule.units.get(metric) or "") if metric else ""
    what = line(metric) if metric else f"{application.spec.constraints.statistic} latency"
    rest = drawn.copy()
    rest[rows] = False
    sides = [(hue, rest & (choice.feasible == meets)) for hue, meets in (("misses", False), ("meets", True))]
    frame = Frame(
        x=Axis.over(f"cost per {REQUESTS_TEXT}", _of_requests, shown_x),
        y=Axis.over(shortened(f"{what} in {unit}" if unit else what, 230), words, [*shown_y, *near]),
        dots=[_dot(choice, row, bars.get(row), bool(predictions.measured[row]), named) for row in rows],
        limits=limits,
        lines=_iso(choice),
        specks=[(hue, x[one], y[one]) for hue, one in sides if one.any()],
    )
    frame.remark = _off(frame, x[drawn], y[drawn])
    return frame


def _end(kept: Floats, limit: float) -> float:
    """Return up to which value machines are shown: beyond the limit, else around what is kept."""
    most = float(max(kept, default=0.0))
    return max(BEYOND * limit if math.isfinite(limit) else AROUND * most or math.inf, BESIDE * most)


def _with(values: list[float], limit: float) -> list[float]:
    """Return what an axis shows: a limit too, unless it is far from every machine."""
    return [*values, limit] if min(values) / OFF < limit < FAR * max(values) else values


def _limits(choice: Choice) -> list[Limit]:
    """Return the limits: on y, on x, and on the price, which is a slope if it does not fix the cost of a request."""
    found, costs, metric = list[Limit](), choice.rule.costs, choice.rule.metric
    ratio, rule = costs.typical_busy_ratio, choice.rule
    for name, most in choice.bounds.items():
        if most > 0 and name in ([f"metrics.{metric}"] if metric else ["latency", "rate"]):
            bare, words = shortened(line(name.removeprefix("metrics.")), 150), shown if metric else seconds
            # That of the middle one of the machines.
            at = float(np.sort(rule.at_rate(most / costs.busy_ratio))[len(rule.names) // 2]) if name == "rate" else most
            found.append(Limit(f"{bare} limit {words(at)}", 0, 1, math.log10(at)))
        elif most > 0 and name == "cost":
            found.append(Limit(f"cost limit {_of_requests(most)}", 1, 0, math.log10(most)))
        elif most > 0 and name == "price":
            per_hour = costs.requests_per_s and costs.requests_per_s * 3600 * costs.used / costs.up
            # On a busy machine, a request costs what is paid times the paid seconds, which are in a ratio to its latency.
            if per_hour or not metric:
                at = math.log10((most + costs.typical_beside_usd_per_hour) / (per_hour or 3600.0 / ratio))
                found.append(Limit(f"price limit {money(most)}/h", 1, 0 if per_hour else -1, at))
    return found


def _dot(choice: Choice, row: int, ends: tuple[float, float] | None, measured: bool, named: dict[str, int]) -> Dot:
    """Return the mark of a machine; its interval follows the cost where a request pays for its time."""
    x, y = float(choice.cost_usd_per_request[row]), float(choice.metric_value[row])
    costs, metric = (x, x), choice.rule.metric
    if ends and not metric:
        of_ends = choice.rule.take(np.array([row])).costs.per_request  # only of this row: costs are columns
        low, high = (float(of_ends(np.array([end]))[0]) for end in ends)
        costs = (low, high) if low and math.isfinite(high) else costs
    chosen, name = row == choice.chosen, _name(choice, row)
    hue = "chosen" if chosen else "meets" if choice.feasible[row] else "misses"
    return Dot(
        title=f"{name}: {(shown if metric else seconds)(y)}, {_of_requests(x)}",
        x=x,
        y=y,
        ends=((costs[0], ends[0]), (costs[1], ends[1])) if ends else None,
        measured=measured,
        diamond=bool(choice.offers.gpu[row]),
        hue="broken" if chosen and not choice.satisfied[row] else hue,
        name=name if row in named.values() else "",
    )


def _iso(choice: Choice) -> list[tuple[str, list[tuple[float, float]]]]:
    """Return the line on which a request costs as much in total as one of the choice."""
    if choice.chosen is None or choice.by_relaxation or not (value := float(choice.objective[choice.chosen])) > 0:
        return []
    alpha, scale = choice.rule.alpha, choice.scale
    cost, y = value * scale.cost / max(1 - alpha, 1e-12), value * scale.metric / max(alpha, 1e-12)
    shares = [1 / (1 + math.exp(-step / 4)) for step in range(-48, 49)]
    return [("iso", [(cost * share, y * (1 - share)) for share in shares])]


def _off(frame: Frame, x: Floats, y: Floats) -> str:
    """Return what the axes leave out, counted."""
    above, right = np.log10(y) > frame.y.high, np.log10(x) > frame.x.high
    below = (np.log10(x) < frame.x.low) | (np.log10(y) < frame.y.low)
    what = "slower" if frame.y.words is seconds else "above"
    worst = f"{what} (up to {frame.y.words(float(y.max()))})"
    counted = ((above, worst), (right & ~above, "more expensive"), (below & ~above & ~right, "below"))
    parts = [f"{int(one.sum()):,} {said}" for one, said in counted if one.any()]
    parts += [one.words for one in frame.limits if not frame.edge(one)]
    return f"off scale: {', '.join(parts)}" if parts else ""


def _of_requests(usd: float) -> str:
    return money(usd * REQUESTS_SHOWN)


def named_of(choice: Choice) -> dict[str, int]:
    """Return the labelled rows by role: the choice and two alternatives, or the nearest if no machine meets the limits."""
    pairs: dict[str, int | None] = {"nearest": choice.least_infeasible}
    pairs |= {f"nearest in {miss.limit}": miss.row for miss in choice.violations}
    if choice.chosen is not None:
        pairs = {"chosen": choice.chosen, "runner-up": runner_up(choice), "ruled out": ruled_out(choice)}
        pairs |= shortlist(choice)
    roles = {row: role for role, row in reversed(pairs.items()) if row is not None}
    return {roles[row]: row for row in list(dict.fromkeys(row for row in pairs.values() if row is not None))[:3]}


def _marked(choice: Choice, drawn: NDArray[np.bool_], first: Sequence[int]) -> list[int]:
    """Return the machines with marks: those named, the measured, the front; each type by its best offer if they are few."""
    rows = np.flatnonzero(drawn)
    rows = rows[np.lexsort((choice.objective[rows], ~choice.feasible[rows]))]
    if choice.latency.posterior:
        rows = rows[np.sort(np.unique(choice.latency.type_index[rows], return_index=True)[1])]
    measured = rows[choice.latency.measured[rows]].tolist()
    others = rows.tolist() if len(rows) <= MARKS else []
    order = dict.fromkeys((*first, *measured, *thinned(choice.front), *others))
    return [row for row in order if drawn[row]][:MARKS]


def limits_words(choice: Choice) -> str:
    """Return the limits as a noun: `both limits`, `the latency limit`."""
    names = list(choice.bounds)
    if len(names) == 1:
        return f"the {line(names[0].removeprefix('metrics.'))} limit"
    return "both limits" if len(names) == 2 else f"all {len(names)} limits"


def title_of(choice: Choice) -> str:
    """Return the finding as a sentence."""
    row = choice.chosen
    if row is None:
        return _none(choice)
    name, limits = _name(choice, row), limits_words(choice)
    if choice.latency.posterior is None:
        few = choice.latency.measured.any()
        return f"{name} looks best; {'too few requests to say how sure' if few else 'no cloud machine was measured'}"
    if not choice.satisfied[row]:
        return f"{name} is the relaxed method's choice, but misses a limit"
    machines = f"of {count(int(choice.eligible.sum()), 'machine')}"
    best = "the only machine" if choice.bounds and choice.feasible.sum() == 1 else "the best"
    if not choice.latency.measured[row]:
        return f"{name} is predicted to be {best} {f'within {limits}' if choice.bounds else machines}"
    if choice.candidates.sum() < choice.feasible.sum():
        best = "the best measured"
    if choice.best is not None and choice.objective[row] > choice.objective[choice.best] * (1 + 1e-9):
        best = "the relaxed method's choice"
    if choice.bounds:
        return f"{name} is {best}{' machine' * best.startswith('the best')} that meets {limits}"
    return f"{name} is {best} {machines}"


def _none(choice: Choice) -> str:
    if choice.feasible.any():
        return "The relaxed method finds no machine, though some meet the limits"
    alone = [miss for miss in choice.violations if miss.alone]
    if len(alone) == 1:
        name, bound = alone[0].limit, alone[0].bound
        limit = line(name.removeprefix("metrics."))
        return f"No machine meets the {limit} limit of {line(shown_limit(name, bound, choice.rule.unit_of(name)))}"
    return f"No machine meets {limits_words(choice)}" if choice.bounds else "No machine can be predicted"


def facts_of(application: Application, choice: Choice) -> str:
    """Return the line about the candidates and the objective."""
    known = choice.latency.measured & choice.eligible
    found = f"{count(int(choice.eligible.sum()), 'machine')}, {len(set(choice.offers.instance[known]))} measured"
    if choice.bounds:
        meet, sure = int(choice.feasible.sum()), choice.confidence and choice.latency.distribution is not None
        surely = f" (P ≥ {choice.confidence:g})" if sure else ""
        found += f", {meet:,} meet{'s' if meet == 1 else ''} {limits_words(choice)}{surely}"
    found += f" · objective: {line(weights(application))}"
    if application.spec.objective.load:
        found += f" · {usage_text(application.spec) or 'billed by whole hours'}"
    return found


def _name(choice: Choice, row: int) -> str:
    return line(choice.offers.instance[row]) + (" spot" if choice.offers.spot[row] else "")


def _figures(choice: Choice, row: int) -> tuple[str, str, str]:
    """Return the objective's metric of a machine, how it is known, and the cost of requests."""
    metric, value = choice.rule.metric, float(choice.metric_value[row])
    unit = shortened(line(choice.rule.units.get(metric) or ""), 40) if metric else ""
    measured = (choice.metrics[metric] if metric else choice.latency).measured[row]
    how = "measured" if measured else "extrapolated" if choice.latency.extrapolated[row] else "predicted"
    words = f"{shown(value)} {unit}".strip() if metric else seconds(value)
    return words, how, _of_requests(float(choice.cost_usd_per_request[row]))


def _lead(choice: Choice) -> list[tuple[str, bool]]:
    """Return the line about the choice: shape, price, latency and cost, of which the last two are bold."""
    if choice.chosen is None:
        return []
    machine, metric = entry_of(choice, choice.chosen), choice.rule.metric
    value, how, cost = _figures(choice, choice.chosen)
    return [
        (f"{shortened(line(machine.shape), 210, LARGE)} · {money(machine.price)}/h · ", False),
        (value, True),
        (f" {shortened(line(metric), 120, LARGE) if metric else 'per request'} ({how}) · ", False),
        (cost, True),
        (f" per {REQUESTS_TEXT}", False),
    ]


def _table(choice: Choice) -> list[tuple[str, str]]:
    """Return the machines beside the choice, with their figures and why they are not chosen, and what it is worth."""
    found = []
    for role, row in named_of(choice).items():
        value, how, cost = _figures(choice, row)
        name = shortened(_name(choice, row), 190)
        if role != "chosen":
            found.append((line(role), f"{name}: {value}, {cost} ({how}); {reason(choice, row)}"))
    if choice.chosen is not None and choice.baseline is not None:
        found.append(("baseline", line(entry_of(choice, choice.chosen).against(entry_of(choice, choice.baseline)))))
    return found


def source_of(choice: Choice, what: str = "Prices") -> str:
    """Return where machines or prices come from, with their date, and what the latency leaves out."""
    about = choice.offers.about
    source = line(about.source.partition(": ")[2] or about.source)
    regions = [region for region in dict.fromkeys(map(str, choice.offers.region)) if region]
    where = line(regions[0]) if len(regions) == 1 else f"{len(regions)} regions" if regions else ""
    parts = [part for part in (shortened(source, 260), shortened(where, 140), line(about.date)) if part]
    return f"{what}: {', '.join(parts)}. Latency excludes the network."
