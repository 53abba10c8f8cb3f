"""The machines of the report's page, and the numbers with which its script chooses among them as `fogspec menu` does.

Only the cheapest offer of a type can be chosen, so that each type is one machine. Of more than `MOST` types those are left out
that cannot win under any limit or weight.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fogspec.choice.choose import Choice
from fogspec.choice.rule import MOST_CERTAIN, TIE, best_attainable
from fogspec.language.schema import Application

MOST = 400
COLUMNS = (
    "mu", "sigma", "tail", "spread", "met", "latency", "value", "cost", "usd_per_s", "busy", "table", "spot", "measured",
    "order",
)  # fmt: skip

Rows = NDArray[np.intp]


def machines_of(choice: Choice) -> tuple[Rows, int]:
    """Return the rows of the machines, the choice first, then those that meet the limits by their objective; and the types."""
    types = cheapest_of_types(choice)
    rows = types if len(types) <= MOST else undominated(choice, types)
    if choice.chosen is not None and choice.chosen not in rows:
        rows = np.append(rows, choice.chosen)
    order = np.lexsort((rows, choice.objective[rows], ~choice.feasible[rows], rows != choice.chosen))
    return rows[order], len(types)


def rule_data(application: Application, choice: Choice, rows: Rows) -> dict[str, Any]:
    """Return the constants of the rule, and of each machine in these rows the columns `COLUMNS` and its fixed quantities.

    `waiting` has the tables of `fogspec.numerics.waiting.Waiting` that `table` is a place in, None where nothing waits.
    `required` is the probability that is required, None where predicted values decide; `sigma` is 0 where no probability is
    known. Infinite values are null.
    """
    spec, rule, latency = application.spec, choice.rule, choice.latency
    metric, given, of = spec.objective.metric, spec.objective.scale, latency.type_index[rows]
    fixed = [name for name in choice.values if name not in ("latency", "cost", "rate")]
    none = np.zeros(len(rows))
    place = sorted(range(len(rows)), key=lambda i: (str(choice.offers.instance[rows[i]]), int(rows[i])))
    met = choice.metrics_probability
    shape = [none] * 4 if latency.distribution is None else [
        getattr(latency.distribution, name)[of] for name in COLUMNS[:4]
    ]  # fmt: skip
    columns = [
        *shape,
        np.ones(len(rows)) if met is None else met[of],
        latency.value[rows],
        choice.metric_value[rows],
        choice.cost_usd_per_request[rows],
        rule.costs.usd_per_s[rows],
        np.broadcast_to(rule.costs.busy_ratio, len(choice.offers))[rows],
        none if rule.waiting is None else rule.waiting.of[rows],
        choice.offers.spot[rows],
        latency.measured[rows],
        np.argsort(place),
        *(choice.values[name][rows] for name in fixed),
    ]
    return {
        "columns": COLUMNS,
        "fixed": [(name.removeprefix("metrics."), choice.bounds[name]) for name in fixed],
        "machines": [[_number(value) for value in one] for one in zip(*columns, strict=True)],
        "alpha": spec.objective.alpha,
        "limits": {"latency": spec.constraints.latency, "cost": spec.constraints.cost},
        "network": spec.constraints.network_allowance,
        "required": choice.confidence,
        "most_certain": MOST_CERTAIN,
        "measured_first": rule.measured_first,
        "tie": TIE,
        "metric": metric,
        "scale": {
            "value": (given.metric or spec.constraints.metrics.get(metric)) if metric else given.latency,
            "cost": given.cost,
            "best_value": best_attainable(choice.metric_value, choice.eligible),
            "best_cost": best_attainable(choice.cost_usd_per_request, choice.eligible),
        },
        "transfer": rule.costs.transfer_usd,
        "requests_per_s": rule.costs.requests_per_s,
        "waiting": None if rule.waiting is None else rule.waiting.tables.tolist(),
        "interruptions_per_s": rule.costs.interruptions_per_s,
    }


def _number(value: Any) -> float | None:
    found = float(value)
    return (int(found) if found.is_integer() and abs(found) < 1e15 else found) if np.isfinite(found) else None


def cheapest_of_types(choice: Choice) -> Rows:
    """Return the cheapest offer of each type and price kind, the first of equals, in the order of the offers.

    All offers of a type have the same predictions, so that the cheapest wins under any weight.
    """
    rows = np.flatnonzero(choice.eligible)
    offers = choice.offers
    columns = (offers.cloud, offers.instance, offers.gpu, offers.gpu_count, offers.spot)
    keys = list(zip(*(column[rows].tolist() for column in columns), strict=True))
    first: dict[tuple[object, ...], int] = {}
    for i in np.lexsort((rows, offers.price_usd_per_hour[rows], choice.rule.costs.usd_per_s[rows])).tolist():
        first.setdefault(keys[i], int(rows[i]))
    return np.array(sorted(first.values()), dtype=np.intp)


def undominated(choice: Choice, rows: Rows) -> Rows:
    """Return the rows that no other row equals or beats in everything that a choice depends on, ties included."""
    measured = choice.latency.measured[rows]
    columns = [
        choice.metric_value,
        choice.latency.value,
        choice.cost_usd_per_request,
        choice.rule.costs.usd_per_s,
        np.broadcast_to(choice.rule.costs.busy_ratio, len(choice.offers)),
        choice.offers.price_usd_per_hour,
        *choice.values.values(),
        *choice.required(choice.confidence).values(),
        *([choice.required_latency_s(choice.confidence)] if choice.confidence and choice.latency.distribution else []),
    ]
    table = np.column_stack([column[rows] for column in columns])
    names = choice.offers.instance[rows].tolist()
    order = sorted(range(len(rows)), key=lambda i: (*table[i, [2, 1]].tolist(), names[i], int(rows[i])))
    table, measured, spot = table[order], measured[order], choice.offers.spot[rows][order]
    waiting = choice.rule.waiting
    waits = np.zeros(len(order)) if waiting is None else waiting.of[rows][order]
    kept: list[int] = []
    for i in range(len(order)):
        before = np.array(kept, dtype=np.intp)
        same = (spot[before] == spot[i]) & (measured[before] >= measured[i]) & (waits[before] == waits[i])
        if not bool((same & (table[before] <= table[i]).all(axis=1)).any()):
            kept.append(i)
    return np.sort(rows[np.array(order, dtype=np.intp)[kept]])
