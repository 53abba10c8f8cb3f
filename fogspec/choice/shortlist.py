"""The shortlist: named alternatives to the chosen machine."""

from fogspec.base import units
from fogspec.base.quantities import Cost, Duration, Price, Strict
from fogspec.base.units import rounded
from fogspec.choice.choose import Choice
from fogspec.choice.menu import MetricValue, entry_of, why_not
from fogspec.language.warned import sentence


class Alternative(Strict):
    """A machine that was not chosen, and why."""

    role: str
    infra: str
    instance: str
    latency: Duration
    cost: Cost
    metrics: dict[str, MetricValue]
    price: Price
    why_not: str


def alternatives(choice: Choice) -> list[Alternative]:
    """Return the other named choices, the runner-up, and the nearest machine that a limit excludes."""
    found: list[Alternative] = []
    for role, row in shortlist(choice).items():
        entry = entry_of(choice, row)
        found.append(
            Alternative(
                role=role,
                infra=entry.infra,
                instance=entry.instance,
                latency=entry.latency,
                cost=entry.cost,
                metrics=entry.metrics,
                price=entry.price,
                why_not=reason(choice, row),
            )
        )
    return found


def reason(choice: Choice, row: int) -> str:
    """Return why a machine is not the choice: the limits that it violates, else its objective."""
    missed = "; ".join(map(sentence, why_not(choice, row)))
    if missed or choice.chosen is None:
        return missed or "meets the limits"
    mine, best = (rounded(float(choice.objective[at])) for at in (row, choice.chosen))
    if mine == best:
        return "equal objective; ties go by cost, latency, name"
    return "objective {} against {}".format(*units.shown_apart(mine, best))


def shortlist(choice: Choice) -> dict[str, int]:
    """Return the rows of the named alternatives to the chosen machine by role, each row once."""
    named = {
        "cheapest": choice.cheapest,
        "fastest": choice.fastest,
        f"least {choice.rule.metric}": choice.least,
        "runner-up": runner_up(choice),
        "ruled out": ruled_out(choice),
    }
    found: dict[str, int] = {}
    for role, row in named.items():
        if row is not None and row != choice.chosen and row not in found.values():
            found[role] = row
    return found


def fallback_rows(choice: Choice, count: int) -> list[int]:
    """Return the best feasible machines except the chosen one, by objective, then cost, latency and name."""
    rows = [int(row) for row in choice.feasible.nonzero()[0] if row != choice.chosen]
    offers, cost, latency = choice.offers, choice.cost_usd_per_request, choice.latency.value
    rows.sort(
        key=lambda row: (choice.objective[row], cost[row], latency[row], offers.instance[row], offers.region[row])
    )
    return rows[:count]


def runner_up(choice: Choice) -> int | None:
    """Return the best feasible machine of another instance type than the chosen one."""
    if choice.chosen is None:
        return None
    other = choice.feasible & (choice.offers.instance != choice.offers.instance[choice.chosen])
    rows = other.nonzero()[0]
    return int(rows[choice.objective[rows].argmin()]) if len(rows) else None


def ruled_out(choice: Choice) -> int | None:
    """Return the machine with the best objective among those that violate a limit."""
    rows = (choice.eligible & ~choice.feasible).nonzero()[0]
    return int(rows[choice.objective[rows].argmin()]) if len(rows) else None
