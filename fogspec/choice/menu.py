"""The menu: the named choices and the Pareto fronts, as people and programs read them."""

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fogspec.base import units
from fogspec.base.quantities import Cost, Duration, Lean, Strict, as_numbers
from fogspec.base.units import rounded
from fogspec.catalog.machine import ListedMachine
from fogspec.choice.choose import Choice
from fogspec.choice.rule import Violation
from fogspec.numerics.kernels import distinct
from fogspec.plan.schema import EnvironmentMetadata
from fogspec.spec.schema import Application, Billing, Statistic, Usage

LEVEL = 0.9
LIMIT_UNITS = {"latency": "s", "rate": "s", "cost": "usd_per_request", "price": "usd_per_hour"}
SHOWN = 40
NEAR = 1.1  # up to this many times a limit, people are shown the excess in percent


class MetricValue(Strict):
    """A metric of the application on one machine: predicted, with its interval at the menu's level, and its limit."""

    value: float
    interval: tuple[float, float] | None
    limit: float | None
    unit: str | None


class Entry(ListedMachine, Lean):
    """A machine on the menu: what it is, what is expected of it, and whether it meets every limit.

    One that is `nested_in` a part of a larger machine was measured there, and not itself.
    """

    latency: Duration
    interval: tuple[Duration, Duration] | None
    metrics: dict[str, MetricValue]
    cost: Cost
    month: str
    objective: float
    measured: bool
    nested_in: str | None = None
    extrapolated: bool
    probability: float | None
    meets: bool
    why_not: str | None

    ADDED = frozenset({"nested_in"})

    @property
    def usd_per_month(self) -> float:
        """The price of a month, in which the machine is up as `objective.usage` says, else always."""
        return float(self.month.removeprefix("$").removesuffix("/month"))

    @property
    def how(self) -> str:
        """Return how its latency is known: `measured`, where it was measured instead, `extrapolated`, or nothing."""
        if self.measured:
            return "measured"
        if self.nested_in is not None:
            return f"measured on {self.nested_in}, not on {self.instance} itself"
        return "extrapolated" if self.extrapolated else ""


class Limit(Strict):
    """A limit that no machine meets together with the others, and how far it would have to move."""

    limit: str
    bound: str
    nearest_value: str
    factor: float
    infra: str
    instance: str
    alone: bool


class MenuBody(Strict):
    """The choices: `balanced` minimises the objective, `least` its metric if that is not the latency.

    Entries of `front` and `hourly_front` rise in cost or price.
    """

    statistic: Statistic
    billing: Billing
    usage: str | None
    objective: str
    metric: str | None
    scale: dict[str, str]
    limits: dict[str, str]
    level: float
    admissible: int
    predicted: int
    meet: int
    balanced: Entry | None
    cheapest: Entry | None
    fastest: Entry | None
    least: Entry | None
    nearest: Entry | None
    missed: list[Limit]
    front: list[Entry]
    hourly_front: list[Entry]
    warnings: list[str]


class Menu(Strict):
    """`kind: Menu`: what is on offer under the limits."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Menu"] = "Menu"
    metadata: EnvironmentMetadata
    spec: MenuBody


def make_menu(application: Application, choice: Choice, warnings: list[str]) -> Menu:
    """Return the menu of a choice."""
    spec = application.spec
    _solve_intervals(choice)

    def entry(row: int | None) -> Entry | None:
        return None if row is None else entry_of(choice, row)

    body = MenuBody(
        statistic=spec.constraints.statistic,
        billing=spec.objective.billing,
        usage=usage_text(spec.objective.usage),
        objective=weights(application),
        metric=spec.objective.metric,
        scale=scale_texts(application, choice),
        level=LEVEL,
        limits={name: limit_text(name, bound, choice.rule.unit_of(name)) for name, bound in choice.bounds.items()},
        admissible=len(choice.offers),
        predicted=int(choice.eligible.sum()),
        meet=int(choice.feasible.sum()),
        balanced=entry(choice.chosen),
        cheapest=entry(choice.cheapest),
        fastest=entry(choice.fastest),
        least=entry(choice.least),
        nearest=entry(choice.least_infeasible),
        missed=[_missed(choice, one) for one in choice.violations],
        front=[entry_of(choice, row) for row in thinned(choice.front)],
        hourly_front=[entry_of(choice, row) for row in thinned(choice.hourly_front)],
        warnings=warnings,
    )
    return Menu(metadata=EnvironmentMetadata(name=application.name), spec=body)


def shown_limit(name: str, value: float, unit: str = "", digits: int = 3) -> str:
    """Return a bound or a value of a limit for people, with so many significant digits."""
    match LIMIT_UNITS.get(name):
        case "s":
            return units.shown_duration(value, digits)
        case "usd_per_request":
            return units.shown_cost(value, digits)
        case "usd_per_hour":
            return units.shown_price(value, digits)
        case _:
            return f"{units.shown(value, digits)} {unit}".strip()


def shown_beside(name: str, value: float, bound: float, unit: str = "") -> tuple[str, str]:
    """Return a value and the bound that it violates for people, with the digits that tell them apart."""
    return units.shown_apart(value, bound, lambda number, digits: shown_limit(name, number, unit, digits))


def shown_miss(miss: "Limit") -> tuple[str, str]:
    """Return for people the bound of a limit that no machine meets, and what the nearest machine needs."""
    unit = miss.bound.partition(" ")[2]
    bound, needs = (_limit_number(miss.limit, text)[1] for text in (miss.bound, miss.nearest_value))
    shown_needs, shown_bound = shown_beside(miss.limit, needs, bound, unit)
    if not math.isfinite(miss.factor):
        return shown_bound, f"{shown_needs}, more than nothing"
    if miss.factor < NEAR:
        return shown_bound, f"{shown_needs}, {units.shown_percent(miss.factor - 1)} over the limit"
    return shown_bound, f"{shown_needs}, {units.shown(miss.factor)} times the limit"


def shown_text(name: str, text: str) -> str:
    """Return for people what `limit_text` wrote."""
    return shown_limit(name, _limit_number(name, text)[1], text.partition(" ")[2])


def menu_data(menu: Menu) -> dict[str, Any]:
    """Return a menu as programs read it: numbers, with the unit in the key."""
    body = menu.spec
    found: dict[str, Any] = as_numbers(body)
    for name, texts in (("limits", body.limits), ("scale", body.scale)):
        found[name] = dict(_limit_number(limit, text) for limit, text in texts.items())
    found["missed"] = [
        {
            **as_numbers(one),
            "unit": LIMIT_UNITS.get(one.limit, one.bound.partition(" ")[2]),
            "bound": _limit_number(one.limit, one.bound)[1],
            "nearest_value": _limit_number(one.limit, one.nearest_value)[1],
        }
        for one in body.missed
    ]
    for name in ("balanced", "cheapest", "fastest", "least", "nearest"):
        found[name] = entry_data(getattr(body, name))
    for name in ("front", "hourly_front"):
        found[name] = [entry_data(one) for one in getattr(body, name)]
    return {"name": menu.metadata.name, **found}


def _limit_number(name: str, text: str) -> tuple[str, float]:
    """Return the key and the number of what `limit_text` wrote."""
    unit = LIMIT_UNITS.get(name)
    match unit:
        case "s":
            value = units.parse_duration_s(text)
        case "usd_per_request":
            value = units.parse_cost_usd_per_request(text)
        case "usd_per_hour":
            value = units.parse_price_usd_per_hour(text)
        case _:
            value = float(text.partition(" ")[0])
    return (f"{name}_{unit}" if unit else name), value


def entry_data(entry: Entry | None) -> dict[str, Any] | None:
    """Return an entry as programs read it; None for none."""
    if entry is None:
        return None
    found: dict[str, Any] = as_numbers(entry)
    del found["month"]
    return {**found, "usd_per_month": entry.usd_per_month}


def _solve_intervals(choice: Choice) -> None:
    """Solve the intervals of all entries together, from which each is then read."""
    named = (choice.chosen, choice.cheapest, choice.fastest, choice.least, choice.least_infeasible)
    rows = [row for row in named if row is not None] + thinned(choice.front) + thinned(choice.hourly_front)
    for predictions in (choice.latency, *choice.metrics.values()):
        predictions.intervals(rows, LEVEL)


def thinned(rows: NDArray[np.intp]) -> list[int]:
    """Return at most `SHOWN` of the rows, spread evenly, with both ends."""
    if len(rows) > SHOWN:
        rows = rows[distinct(np.linspace(0, len(rows) - 1, SHOWN).round().astype(int))]
    return [int(row) for row in rows]


def entry_of(choice: Choice, row: int) -> Entry:
    """Return the menu entry of one offer."""
    machine = choice.offers.machine(row)
    interval = choice.latency.interval(row, LEVEL)
    return Entry(
        **dict(machine),
        latency=rounded(float(choice.latency.value[row])),
        interval=None if interval is None else (rounded(interval[0]), rounded(interval[1])),
        metrics=_metrics_of(choice, row),
        cost=rounded(float(choice.cost_usd_per_request[row])),
        month=f"${choice.rule.costs.usd_per_month[row]:.2f}/month",
        objective=rounded(float(choice.objective[row])),
        measured=bool(choice.latency.measured[row]),
        nested_in=choice.latency.where_nested(row),
        extrapolated=bool(choice.latency.extrapolated[row]),
        probability=_probability(choice, row),
        meets=bool(choice.feasible[row]),
        why_not=why_not(choice, row),
    )


def _metrics_of(choice: Choice, row: int) -> dict[str, MetricValue]:
    found = {}
    for name, predictions in choice.metrics.items():
        value, ends = float(predictions.value[row]), predictions.interval(row, LEVEL)
        if math.isfinite(value):
            found[name] = MetricValue(
                value=rounded(value),
                interval=None if ends is None else (rounded(ends[0]), rounded(ends[1])),
                limit=choice.rule.max_metrics.get(name),
                unit=choice.rule.units.get(name),
            )
    return found


def metric_text(name: str, found: MetricValue) -> str:
    """Return `path_length 33.3 m [31, 36]`."""
    ends = ", ".join(units.shown(end) for end in found.interval) if found.interval else ""
    unit = f" {found.unit}" if found.unit else ""
    return f"{name} {units.shown(found.value)}{unit}" + (f" [{ends}]" if ends else "")


def why_not(choice: Choice, row: int) -> str | None:
    """Return the limits that an offer violates as text; None if it is feasible."""
    if choice.feasible[row]:
        return None
    broken = [
        "{} {} is over the limit of {}".format(
            name.removeprefix("metrics."), *shown_beside(name, float(value), bound, choice.rule.unit_of(name))
        )
        if math.isfinite(value := choice.values[name][row])
        else f"{name.removeprefix('metrics.')} is not known: no sample has a value of it that can be modelled"
        for name, bound in choice.bounds.items()
        if not choice.values[name][row] <= bound
    ]
    if broken:
        return "; ".join(broken)
    if choice.latency.unfit[row]:
        return "it failed when it was measured, or has no more memory than a machine that ran out of it"
    required = choice.confidence if choice.level is None else choice.level
    probability = floored(choice.probability(row) or 0)
    return f"meets the limits with {100 * probability:.3g}% probability, below the required {100 * required:.3g}%"


def shown_probability(probability: float) -> str:
    """Return `0.32`, and `less than 0.01` where 0.00 would read as never."""
    return f"{probability:.2f}" if probability >= 0.01 or probability == 0 else "less than 0.01"


def floored(probability: float) -> float:
    """Return a probability with three digits, rounded down: 0.8999 must not read "0.9, below 0.9"."""
    return math.floor(1000 * probability) / 1000


def _probability(choice: Choice, row: int) -> float | None:
    found = choice.probability(row)
    return None if found is None else floored(found)


def _missed(choice: Choice, one: Violation) -> Limit:
    machine = choice.offers.machine(one.row)
    return Limit(
        limit=one.limit,
        bound=limit_text(one.limit, one.bound, choice.rule.unit_of(one.limit)),
        nearest_value=limit_text(one.limit, one.value, choice.rule.unit_of(one.limit)),
        factor=rounded(one.factor),
        infra=machine.infra,
        instance=machine.instance,
        alone=one.alone,
    )


def usage_text(usage: Usage | None) -> str | None:
    """Return when the machine is up, with the hours that a month has of it; None if always."""
    if usage is None:
        return None
    startup = f" after {units.shown_duration(usage.startup)} of start-up" if usage.startup else ""
    each = f"{units.shown_duration(usage.session)}{startup}, {units.format_rate(usage.sessions)}"
    return f"up for {each}: {units.shown(usage.up * units.HOURS_PER_MONTH)} h per month"


def weights(application: Application) -> str:
    """Return the weights as text: `0.70 latency + 0.30 cost`."""
    objective = application.spec.objective
    return f"{objective.alpha:.2f} {objective.metric or 'latency'} + {1 - objective.alpha:.2f} cost"


def scale_texts(application: Application, choice: Choice) -> dict[str, str]:
    """Return the divisors of the metric and the cost as text."""
    metric = application.spec.objective.metric
    divisor = rounded(choice.scale.metric)
    unit = choice.rule.units.get(metric, "") if metric else ""
    of_metric = f"{units.format_number(divisor)} {unit}".strip() if metric else units.format_duration(divisor)
    return {metric or "latency": of_metric, "cost": units.format_cost(rounded(choice.scale.cost))}


def limit_text(name: str, value: float, unit: str = "") -> str:
    """Return a bound or a value of a limit with its unit, which only metrics need."""
    value = rounded(value)
    match name:
        case "latency" | "rate":
            return units.format_duration(value)
        case "cost":
            return units.format_cost(value)
        case "price":
            return units.format_price(value)
        case _:
            return f"{units.format_number(value)} {unit}".strip()
