"""The menu: the named choices and the Pareto front, as people and programs read them."""

import math
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fogspec.base import units
from fogspec.base.quantities import Cost, Duration, Lean, Memory, Money, Strict, as_numbers
from fogspec.base.units import LIMIT_UNITS, rounded, shown_beside, shown_limit
from fogspec.catalog.machine import ListedMachine
from fogspec.choice.choose import Choice
from fogspec.choice.outlook import Cause, Outlook
from fogspec.choice.relaxed import Relaxed
from fogspec.choice.rule import Violation
from fogspec.language import warned as codes
from fogspec.language.schema import Application, Billing, Spec, Statistic
from fogspec.language.warned import Warned, as_data, warned
from fogspec.numerics.kernels import distinct
from fogspec.plan.schema import EnvironmentMetadata

LEVEL = 0.9
SHOWN = 40
Role = Literal["balanced", "cheapest", "fastest", "least", "nearest", "baseline", "exhaustive"]
NEAR = 1.1  # up to this many times a limit, people are shown the excess in percent


class MetricValue(Strict):
    """A metric of the application on one machine: predicted, with its interval at the menu's level, and its limit."""

    value: float
    interval: tuple[float, float] | None = None
    limit: float | None = None
    unit: str | None = None


class Entry(ListedMachine):
    """A machine on the menu: what it is, what is expected of it, whether it meets every limit, and what it is named for.

    `month` is its price of a month, with disk and address, where that is not 730 times `price`.
    """

    latency: Duration
    interval: tuple[Duration, Duration] | None = None
    metrics: dict[str, MetricValue] = Field({})
    cost: Cost
    month: str | None = None
    objective: float
    measured: bool = False
    extrapolated: bool = False
    probability: float | None = None
    meets: bool = True
    why_not: list[Warned] = Field([])
    roles: list[Role] = Field([])

    @property
    def name(self) -> str:
        """Return `g4dn.xlarge spot`."""
        return f"{self.instance}{' spot' if self.spot else ''}"

    @property
    def shape(self) -> str:
        """Return `4 vCPU, 16 GiB, 1 T4`."""
        gpu = f", {self.gpu.label}" if self.gpu else ""
        return f"{units.shown(self.cpus)} vCPU, {units.shown(self.memory)} GiB{gpu}"

    def against(self, other: "Entry") -> str:
        """Return `6.3 times cheaper and 17% faster than c6i.16xlarge`."""
        return units.against(self.latency, self.cost, other.name, other.latency, other.cost)

    @property
    def usd_per_month(self) -> float:
        """The price of a month with disk and address, in which the machine is up as `objective.load` says, else always."""
        if self.month is None:
            return round(self.price * units.HOURS_PER_MONTH, 2)
        return float(self.month.removeprefix("$").removesuffix("/month"))

    @property
    def how(self) -> str:
        """Return how its latency is known: `measured`, `extrapolated`, or nothing."""
        if self.measured:
            return "measured"
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


class Open(Lean):
    """Why no machine is chosen, and the one that is nearest to it: `fogspec.choice.outlook.Outlook`.

    `probability` is that of meeting all limits now, `confidence` the required one, `needs` the limit on latency that it would
    meet with that.
    """

    cause: Cause
    infra: str
    instance: str
    measured: bool
    confidence: float | None = None
    probability: float | None = None
    needs: Duration | None = None
    usd: Money | None = None


class PaperChoice(Strict):
    """Where the paper's method ends: a continuous optimum, its nearest machine, and the one that meets the limits.

    `latency` is what its own curve predicts. `objective` and `meets` say what the exhaustive choice's model predicts.
    """

    cpus: float
    memory: Memory
    rounded: str
    instance: str | None = None
    infra: str | None = None
    latency: Duration | None = None
    objective: float | None = None
    meets: bool | None = None


class MenuBody(Lean):
    """The machines, each once: the `front`, which rises in cost, and `others` that are named for a role.

    `balanced` minimises the objective, `least` its metric if that is not the latency. `baseline` is what people would take
    without a benchmark: the measured machine with the most vCPUs and without a GPU. `relaxed` and the role `exhaustive` say
    where these methods end if they end at another machine.
    """

    statistic: Statistic
    billing: Billing
    usage: str | None = None
    objective: str
    metric: str | None = None
    scale: dict[str, str]
    limits: dict[str, str]
    level: float
    admissible: int
    predicted: int
    meet: int
    front: list[Entry] = Field([])
    others: list[Entry] = Field([])
    missed: list[Limit] = Field([])
    open: Open | None = None
    relaxed: PaperChoice | None = None
    warnings: list[Warned] = Field([])

    def of(self, role: Role) -> Entry | None:
        """Return the machine of a role; None if there is none."""
        return next((one for one in (*self.front, *self.others) if role in one.roles), None)

    @property
    def balanced(self) -> Entry | None:
        """The choice; None if no machine meets the limits."""
        return self.of("balanced")


class Menu(Strict):
    """`kind: Menu`: what is on offer under the limits."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Menu"] = "Menu"
    metadata: EnvironmentMetadata
    spec: MenuBody


def make_menu(
    application: Application,
    choice: Choice,
    warnings: list[Warned],
    relaxed: Relaxed | None = None,
    outlook: Outlook | None = None,
) -> Menu:
    """Return the menu of a choice, with the optimum of the paper's method, `relaxed`, if it differs."""
    spec, roles, front = application.spec, _roles(choice), thinned(choice.front)

    def entry(row: int) -> Entry:
        return entry_of(choice, row).model_copy(update={"roles": [role for role, of in roles.items() if of == row]})

    body = MenuBody(
        statistic=spec.constraints.statistic,
        billing=spec.objective.billing,
        usage=usage_text(spec),
        objective=weights(application),
        metric=spec.objective.metric,
        scale=scale_texts(application, choice),
        level=LEVEL,
        limits={name: limit_text(name, bound, choice.rule.unit_of(name)) for name, bound in choice.bounds.items()},
        admissible=len(choice.offers),
        predicted=int(choice.eligible.sum()),
        meet=int(choice.feasible.sum()),
        front=[entry(row) for row in front],
        others=[entry(row) for row in dict.fromkeys(roles.values()) if row not in front],
        missed=[_missed(choice, one) for one in choice.violations],
        open=None if outlook is None else _open(choice, outlook, spec.constraints.network_allowance),
        relaxed=None if relaxed is None or relaxed.row == choice.best else _paper_choice(choice, relaxed),
        warnings=warnings,
    )
    return Menu(metadata=EnvironmentMetadata(name=application.name), spec=body)


def why_open(menu: Menu) -> list[str]:
    """Return why a menu has no machine to choose, then what is known and would change that; none if it does not say."""
    one, missed = menu.spec.open, menu.spec.missed
    if one is None:
        return []
    name = f"{one.instance} in {one.infra}{'' if one.measured else ' (not measured)'}"
    required = "" if one.confidence is None else f", required {one.confidence:g}"
    met = f"{name}: P(all limits) {shown_probability(one.probability or 0.0)}{required}"
    costs = f"costs at most {units.dollars(one.usd)}" if one.usd else "is free"
    match one.cause:
        case "unknown" if one.measured:
            said = f"not settled: too few requests to say how sure their {menu.spec.statistic} is"
            return [
                said,
                "no probability is known: raise spec.benchmark.stop, or set spec.constraints.confidence: none",
            ]
        case "unknown":
            said = "not settled: nothing was measured on machines on offer"
            return [said, "no probability is known: measure there, or set spec.constraints.confidence: none"]
        case "one sample":
            return ["not settled: one more sample may decide", met, f"a sample of it {costs}"]
        case "too little known" if one.usd is None:
            why = "it failed when it was measured, or spec.benchmark.machines does not list it"
            return ["too little known: no sample of the nearest machine can be taken", met, why]
        case "too little known":
            said = "too little known: the budget does not pay for one more sample"
            return [said, met, f"a sample of it {costs}: raise spec.benchmark.budget"]
        case "too little room":
            ways = [f"confidence: {one.probability:g}"] if one.probability else []
            if one.needs is not None:
                ways.append(f"latency: {units.shown_duration(_above(one.needs))}")
            said = "too little room: no machine meets the limits surely enough"
            would = [f"it would meet {' or '.join(ways)} in spec.constraints"] if ways else []
            return [said, f"{met}, on another server of its type", *would]
    which = {"latency": "too slow", "rate": "too slow", "cost": "too expensive", "price": "too expensive"}
    said = which.get(missed[0].limit, f"{missed[0].limit.removeprefix('metrics.')} too large") if missed else "too slow"
    return [
        f"{said}: no machine meets the limits{' as predicted' if one.confidence is None else ', and no sample changes this'}"
    ]


def _above(value: float) -> float:
    """Return a value rounded up to three digits."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{math.ceil(value / digit - 1e-9) * digit:.6g}")


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
    found |= {role: entry_data(body.of(role)) for role in get_args(Role)}
    found["warnings"] = as_data(body.warnings)
    found |= {name: [entry_data(one) for one in getattr(body, name)] for name in ("front", "others")}
    return {"name": menu.metadata.name, **found}


def _paper_choice(choice: Choice, relaxed: Relaxed) -> PaperChoice:
    end = None if relaxed.row is None else entry_of(choice, relaxed.row)
    return PaperChoice(
        cpus=rounded(relaxed.vcpus),
        memory=rounded(relaxed.memory_gib),
        rounded=str(choice.offers.instance[relaxed.rounded]),
        instance=end and end.instance,
        infra=end and end.infra,
        latency=None if relaxed.row is None else rounded(float(relaxed.selection.latency.value[relaxed.row])),
        objective=end and end.objective,
        meets=end and end.meets,
    )


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
    return {**found, "why_not": as_data(entry.why_not), "usd_per_month": entry.usd_per_month}


def rows_of(choice: Choice) -> list[int]:
    """Return the rows of the offers that the menu shows, named ones first."""
    return [*_roles(choice).values(), *thinned(choice.front)]


def _roles(choice: Choice) -> dict[Role, int]:
    """Return the rows of the offers that are named, by role."""
    rows: dict[Role, int | None] = {
        "balanced": choice.chosen,
        "cheapest": choice.cheapest,
        "fastest": choice.fastest,
        "least": choice.least,
        "nearest": choice.least_infeasible,
        "baseline": None if choice.chosen is None else choice.baseline,
        "exhaustive": None if choice.best == choice.chosen else choice.best,
    }
    return {role: row for role, row in rows.items() if row is not None}


def thinned(rows: NDArray[np.intp]) -> list[int]:
    """Return at most `SHOWN` of the rows, spread evenly, with both ends."""
    if len(rows) > SHOWN:
        rows = rows[distinct(np.linspace(0, len(rows) - 1, SHOWN).round().astype(int))]
    return [int(row) for row in rows]


def entry_of(choice: Choice, row: int) -> Entry:
    """Return the menu entry of one offer."""
    machine, up = choice.offers.machine(row), choice.rule.costs.up
    interval, paid = choice.latency.interval(row, LEVEL), machine.paid_usd_per_hour
    return Entry(
        **dict(machine),
        latency=rounded(float(choice.latency.value[row])),
        interval=None if interval is None else (rounded(interval[0]), rounded(interval[1])),
        metrics=_metrics_of(choice, row),
        cost=rounded(float(choice.cost_usd_per_request[row])),
        month=None if (up, paid) == (1, machine.price) else month_text(paid * units.HOURS_PER_MONTH * up),
        objective=rounded(float(choice.objective[row])),
        measured=bool(choice.latency.measured[row]),
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


def month_text(usd: float) -> str:
    """Return `$383.98/month`."""
    return f"${usd:.2f}/month"


def metric_text(name: str, found: MetricValue) -> str:
    """Return `path_length 33.3 m [31, 36]`."""
    ends = ", ".join(units.shown(end) for end in found.interval) if found.interval else ""
    unit = f" {found.unit}" if found.unit else ""
    return f"{name} {units.shown(found.value)}{unit}" + (f" [{ends}]" if ends else "")


def why_not(choice: Choice, row: int) -> list[Warned]:
    """Return what an offer violates; nothing if it is feasible."""
    if choice.feasible[row]:
        return []
    values = {name: float(choice.values[name][row]) for name in choice.bounds}
    broken = [
        warned(
            codes.over_limit,
            limit=name,
            bound=bound,
            value=values[name] if math.isfinite(values[name]) else None,
            unit=choice.rule.unit_of(name) or None,
        )
        for name, bound in choice.bounds.items()
        if not values[name] <= bound
    ]
    if broken:
        return broken
    if choice.latency.unfit[row]:
        return [warned(codes.machine_failed)]
    return [warned(codes.unlikely, probability=_probability(choice, row), required=choice.confidence or 0.0)]


def shown_probability(probability: float) -> str:
    """Return `0.32`, and `less than 0.01` where 0.00 would read as never: it may be 0 of a number of draws."""
    return f"{probability:.2f}" if probability >= 0.01 else "less than 0.01"


def floored(probability: float) -> float:
    """Return a probability with three digits, rounded down: 0.8999 must not read "0.9, below 0.9"."""
    return math.floor(1000 * probability) / 1000


def _probability(choice: Choice, row: int) -> float | None:
    found = choice.probability(row)
    return None if found is None else floored(found)


def _open(choice: Choice, one: Outlook, network_s: float) -> Open:
    machine, needed = choice.offers.machine(one.row), choice.confidence
    latency = "latency" in choice.bounds and choice.latency.distribution is not None and needed is not None
    needs = float(choice.required_latency_s(needed)[one.row]) if latency and needed is not None else math.inf
    return Open(
        cause=one.cause,
        infra=machine.infra,
        instance=machine.instance,
        measured=bool(choice.latency.measured[one.row]),
        confidence=needed,
        probability=_probability(choice, one.row),
        needs=rounded(needs + network_s) if math.isfinite(needs) else None,
        usd=None if one.usd is None else rounded(one.usd),
    )


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


def usage_text(spec: Spec) -> str | None:
    """Return when the machine is up, with the hours that a month has of it; None if always."""
    load, startup_s = spec.objective.load, spec.hardware.startup
    if load is None or load.session is None or load.sessions is None:
        return None
    if not spec.ends_sessions:
        return f"up always: spec.deployment.until does not end it after {units.shown_duration(load.session)}"
    startup = f" after {units.shown_duration(startup_s)} of start-up" if startup_s else ""
    each = f"{units.shown_duration(load.session)}{startup}, {units.format_rate(load.sessions)}"
    return f"up for {each}: {units.shown(spec.up * units.HOURS_PER_MONTH)} h per month"


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
