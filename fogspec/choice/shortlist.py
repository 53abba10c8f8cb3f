"""The machines worth naming beside the chosen one."""

from fogspec.choice.choose import Choice


def shortlist(choice: Choice) -> dict[str, int]:
    """The rows worth naming beside the chosen one, each once, by what they stand out for."""
    named = {
        "cheapest": choice.cheapest,
        "fastest": choice.fastest,
        "runner-up": _second(choice),
        "ruled out": _ruled_out(choice),
    }
    found: dict[str, int] = {}
    for role, row in named.items():
        if row is not None and row != choice.chosen and row not in found.values():
            found[role] = row
    return found


def fallback_rows(choice: Choice, count: int) -> list[int]:
    """The best machines beside the chosen one that meet the limits, by objective, then cost, latency and name."""
    rows = [int(row) for row in choice.feasible.nonzero()[0] if row != choice.chosen]
    offers, cost, latency = choice.offers, choice.cost_usd_per_request, choice.latency.value
    rows.sort(
        key=lambda row: (choice.objective[row], cost[row], latency[row], offers.instance[row], offers.region[row])
    )
    return rows[:count]


def _second(choice: Choice) -> int | None:
    """The best feasible machine of another instance type than the chosen one."""
    if choice.chosen is None:
        return None
    other = choice.feasible & (choice.offers.instance != choice.offers.instance[choice.chosen])
    rows = other.nonzero()[0]
    return int(rows[choice.objective[rows].argmin()]) if len(rows) else None


def _ruled_out(choice: Choice) -> int | None:
    """The machine with the best objective among those that break a limit."""
    rows = (choice.eligible & ~choice.feasible).nonzero()[0]
    return int(rows[choice.objective[rows].argmin()]) if len(rows) else None
