"""What there is to say of a choice, once: its facts as blocks of cells, which the terminal and the page both show."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from fogspec.base import units
from fogspec.base.text import count, line, table
from fogspec.choice.menu import metric_text
from fogspec.choice.rule import latency_limit_s
from fogspec.compile.manifest import scope_of

if TYPE_CHECKING:
    from fogspec.choice.menu import Entry, Menu
    from fogspec.compile.artifacts import Artifacts
    from fogspec.language.schema import Application

COST = f"per {units.REQUESTS_SHOWN:,}"


@dataclass(frozen=True, slots=True)
class Block:
    """Rows of cells, below headings if it is a table; `notes` stand beneath, `numbers` are the columns of numbers."""

    rows: Sequence[Sequence[str]]
    heads: Sequence[str] = ()
    notes: Sequence[str] = ()
    numbers: Sequence[int] = ()

    def text(self, width: int) -> list[str]:
        """Return the lines of the table, at most `width` wide, with its notes on one line; none without rows."""
        if not self.rows:
            return []
        cells = [[line(cell) for cell in row] for row in (self.heads, *self.rows)]
        return [*table(cells, width, 0), *([f"  {'; '.join(self.notes)}"] if self.notes else [])]


def machine_of(entry: "Entry") -> str:
    """Return `g4dn.xlarge  4 vCPU, 16 GiB, 1 T4  aws/us-east-1  measured`."""
    return f"{entry.name}  {entry.shape}  {entry.infra}  {how(entry)}"


def how(entry: "Entry") -> str:
    """Return how the latency is known: `measured`, `predicted`, or `predicted, extrapolated`."""
    return entry.how if entry.measured else ", ".join(filter(None, ("predicted", entry.how)))


def latency_of(entry: "Entry") -> str:
    """Return `1.65 s [1.51, 1.81]`."""
    return f"{units.shown_duration(entry.latency)}{units.shown_interval(entry.interval)}"


def baseline_of(menu: "Menu") -> str:
    """Return `6.3 times cheaper and 17% faster than c6i.16xlarge`; empty without a choice or a baseline."""
    one, other = menu.spec.balanced, menu.spec.of("baseline")
    return "" if one is None or other is None else one.against(other)


def card(menu: "Menu", application: "Application") -> Block:
    """Return the choice in rows (quantity, value, limit, room), none without one."""
    entry, limits = menu.spec.balanced, application.spec.constraints
    if entry is None:
        return Block([])
    values: list[tuple[str, str, float, float | None, Callable[[float], str]]] = [
        ("latency", latency_of(entry), entry.latency, latency_limit_s(application), units.shown_duration),
        ("cost", units.shown_cost(entry.cost), entry.cost, limits.cost, _of_requests),
        *(
            (name, metric_text("", one).strip(), one.value, one.limit, partial(_in_unit, unit=one.unit))
            for name, one in entry.metrics.items()
        ),
    ]
    rows = [
        (name, text, "", "")
        if bound is None
        else (name, text, f"limit {show(bound)}", units.headroom_text(value, bound))
        for name, text, value, bound, show in values
    ]
    price = f"{units.shown_price(entry.price)}, {units.shown_month(entry.usd_per_month)}"
    met = "" if entry.probability is None else f"P(all limits) {entry.probability:.3g}"
    rows.append(("price", price, met, ""))
    if entry.beside_words:
        rows.append(("", f"with {entry.beside_words}", "", ""))
    more = {"network": scope_of(application), "baseline": baseline_of(menu)}
    return Block([*rows, *((name, words, "", "") for name, words in more.items() if words)])


def _of_requests(usd: float) -> str:
    return units.money(units.REQUESTS_SHOWN * usd)


def machines(menu: "Menu", entries: Sequence["Entry"]) -> Block:
    """Return the table of machines with their marks, and what the marks mean."""
    body, metrics = menu.spec, list(dict.fromkeys(name for e in entries for name in e.metrics))
    chosen = None if body.balanced is None else body.balanced.machine
    many = len({entry.infra for entry in entries}) > 1
    heads = [
        *("", "machine", *(["infra"] if many else []), "vCPU", "GiB", "price", "latency"),
        *(f"{name}{_limit_of(entries, name)}" for name in metrics),
        *(COST, "P"),
    ]
    rows = [
        [
            ">" if e.machine == chosen else "" if e.meets else "-",
            e.name + (f" {e.gpu.count:g}x{e.gpu.name}" if e.gpu else ""),
            *([e.infra] if many else []),
            f"{e.cpus:g}",
            units.shown(e.memory),
            units.shown_price(e.price),
            f"{'' if e.measured else '~'}{latency_of(e)}",
            *(metric_text("", e.metrics[name]).strip() if name in e.metrics else "-" for name in metrics),
            _of_requests(e.cost),
            "" if e.probability is None else f"{e.probability:.3g}",
        ]
        for e in entries
    ]
    notes = [*_named(menu), *(["- misses a limit"] if not all(e.meets for e in entries) else [])]
    notes += ["~ predicted, not measured"] if not all(e.measured for e in entries) else []
    left = body.predicted - len(entries)
    return Block(rows, heads, [*notes, *([f"{left:,} more"] if left > 0 else [])], range(2 + many, len(heads)))


def _named(menu: "Menu") -> list[str]:
    """Return what the choice is besides, and which other machines are the cheapest, the fastest and the best in the metric."""
    body = menu.spec
    if body.balanced is None:
        return []
    roles = {"cheapest": body.of("cheapest"), "fastest": body.of("fastest"), f"least {body.metric}": body.of("least")}
    there = {role: entry for role, entry in roles.items() if entry is not None}
    same = [role for role, entry in there.items() if entry.machine == body.balanced.machine]
    others = [f"{role}: {entry.instance}" for role, entry in there.items() if role not in same]
    beside = f" with {body.balanced.beside_what}" if body.balanced.beside_what else ""
    return [f"> {', '.join(['choice', *same])}, {units.shown_month(body.balanced.usd_per_month)}{beside}", *others]


def _in_unit(value: float, unit: str | None) -> str:
    return f"{units.shown(value)} {unit}" if unit else units.shown(value)


def _limit_of(entries: Sequence["Entry"], name: str) -> str:
    limit = next((e.metrics[name].limit for e in entries if name in e.metrics), None)
    return "" if limit is None else f" <= {units.format_number(limit)}"


def measured_of(compiled: "Artifacts") -> str:
    """Return `12 of 12 samples count; $1.31 spent of a budget of $6.00`; empty before there are results."""
    decision, results, budget = compiled.decision, compiled.results, compiled.plan.spec.budget
    if decision is None or results is None:
        return ""
    left, usable = decision.unfinished, len(decision.models.observations)
    all_of = len({one.id for one in results.spec.samples} | set(() if left is None else left.missing))
    planned = "" if left is None else "planned "
    of_budget = "" if budget is None else f" of a budget of {units.dollars(budget)}"
    return f"{usable} of {all_of} {planned}samples count; {units.dollars(results.spec.spent)} spent{of_budget}"


def meeting(menu: "Menu") -> str:
    """Return `3 of 24 machines meet the limits`."""
    body = menu.spec
    verb = "meets" if 1 in (body.meet, body.predicted) else "meet"
    return f"{body.meet} of {count(body.predicted, 'machine')} {verb} the limits"
