"""Compute the data with which the report page recomputes the choice, with the same result as `fogspec menu`.

Only the cheapest offer of a type can be chosen, so that each type is one row. If there are more than `MOST` types,
dominated types are omitted: they cannot win under any limit or weight.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fogspec.base.units import REQUESTS_SHOWN, REQUESTS_TEXT, rounded
from fogspec.catalog.table import Floats
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, floored
from fogspec.choice.rule import TIE, best_attainable
from fogspec.spec.schema import Application

MOST = 1500
LONGEST = 1e300  # JSON has no infinity

Rows = NDArray[np.intp]


def menu_data(application: Application, choice: Choice) -> dict[str, Any]:
    """Return the data of the page: the constants of the rule, and columns over the offers that can win.

    `needed` has, for each probability level, the latency limit that an offer requires. `needs` is the limit that would be
    required if no machine meets all of them.
    """
    spec, costs = application.spec, choice.rule.costs
    needed, needs = _needed(choice), choice.required(choice.rule.levels[-1])
    types = cheapest_of_types(choice)
    rows = types if len(types) <= MOST else undominated(choice, needed, types)
    offers = choice.offers
    metric, given = spec.objective.metric, spec.objective.scale
    fixed = {
        name: (values, choice.bounds[name])
        for name, values in choice.values.items()
        if name not in ("latency", "cost", "rate")
    }
    low, high = _ends(choice, rows, metric)
    return {
        "name": application.name,
        "alpha": spec.objective.alpha,
        "statistic": spec.constraints.statistic,
        "metric": metric,
        "unit": (spec.metrics[metric].unit or "") if metric else "s",
        "level": LEVEL,
        "limits": {"latency": spec.constraints.latency, "cost": spec.constraints.cost},
        "network": spec.constraints.network_allowance,
        "confidence": choice.confidence,
        "floors": list(choice.rule.levels),
        "probabilities": choice.latency.posterior is not None,
        "adaptive": spec.benchmark.is_adaptive,
        "tie": TIE,
        "relaxed": spec.objective.method == "relaxed",
        "scale": {
            "x": (given.metric or spec.constraints.metrics.get(metric)) if metric else given.latency,
            "cost": given.cost,
            "best_x": best_attainable(choice.metric_value, choice.eligible),
            "best_cost": best_attainable(choice.cost_usd_per_request, choice.eligible),
        },
        "costs": {
            "transfer": costs.transfer_usd,
            "requests_per_s": costs.requests_per_s,
            "interruptions_per_s": costs.interruptions_per_s,
        },
        "per": [REQUESTS_SHOWN, REQUESTS_TEXT],
        "per_hour": costs.requests_per_s and costs.requests_per_s * 3600 * costs.used / costs.up,
        "admissible": len(offers),
        "types": len(types),
        "complete": len(rows) == len(types),
        "fixed": [
            {"name": name, "bound": bound, "value": _numbers(values[rows]), "needs": _numbers(needs[name][rows])}
            for name, (values, bound) in fixed.items()
        ],
        "offers": {
            "row": rows.tolist(),
            "name": offers.instance[rows].tolist(),
            "infra": [offers.infra(row) for row in rows],
            "spot": offers.spot[rows].astype(int).tolist(),
            "measured": choice.latency.measured[rows].astype(int).tolist(),
            "vcpus": offers.vcpus[rows].tolist(),
            "memory": offers.memory_gib[rows].tolist(),
            "gpu": [f"{offers.gpu_count[row]:g} {offers.gpu[row]}" if offers.gpu[row] else "" for row in rows],
            "price": offers.price_usd_per_hour[rows].tolist(),
            "usd_per_s": costs.usd_per_s[rows].tolist(),
            "x": choice.metric_value[rows].tolist(),
            "latency": choice.latency.value[rows].tolist(),
            "cost": choice.cost_usd_per_request[rows].tolist(),
            "low": low,
            "high": high,
            "needed": [_numbers(column[rows]) for column in needed],
            "needs": _numbers(choice.lenient_latency_s[rows]),
            "month": [rounded(usd) for usd in costs.usd_per_month[rows].tolist()],
            "probability": _probabilities(choice, rows),
        },
    }


def _needed(choice: Choice) -> list[Floats]:
    if choice.latency.posterior is None:
        return []
    return [choice.required_latency_s(level) for level in choice.rule.levels]


def cheapest_of_types(choice: Choice) -> Rows:
    """Return the cheapest offer of each type and price kind, the first of equals, in the order of the offers.

    All offers of a type have the same predictions, so that the cheapest wins under any weight.
    """
    rows = np.flatnonzero(choice.eligible)
    if not len(rows):
        return rows
    offers = choice.offers
    kind = {key: i for i, key in enumerate(dict.fromkeys(_keys(choice, rows)))}
    key = np.fromiter((kind[one] for one in _keys(choice, rows)), np.int64, len(rows))
    order = np.lexsort((rows, offers.price_usd_per_hour[rows], choice.rule.costs.usd_per_s[rows], key))
    first = np.append(True, key[order][1:] != key[order][:-1])
    return np.sort(rows[order[first]])


def _keys(choice: Choice, rows: Rows) -> list[tuple[object, ...]]:
    offers = choice.offers
    columns = (offers.cloud, offers.instance, offers.gpu, offers.gpu_count, offers.spot)
    return list(zip(*(column[rows].tolist() for column in columns), strict=True))


def undominated(choice: Choice, needed: list[Floats], rows: Rows) -> Rows:
    """Return the rows that no other row equals or beats in everything that a choice depends on, ties included."""
    measured = choice.latency.measured[rows]
    columns = [
        choice.metric_value,
        choice.latency.value,
        choice.cost_usd_per_request,
        choice.rule.costs.usd_per_s,
        choice.offers.price_usd_per_hour,
        *needed,
        choice.lenient_latency_s,
        *choice.values.values(),
        *choice.required(choice.rule.levels[-1]).values(),
    ]
    table = np.column_stack([column[rows] for column in columns])
    names = choice.offers.instance[rows].tolist()
    order = sorted(range(len(rows)), key=lambda i: (*table[i, [2, 1]].tolist(), names[i], int(rows[i])))
    table, measured, spot = table[order], measured[order], choice.offers.spot[rows][order]
    kept: list[int] = []
    for i in range(len(order)):
        before = np.array(kept, dtype=np.intp)
        same = (spot[before] == spot[i]) & (measured[before] >= measured[i])
        if not bool((same & (table[before] <= table[i]).all(axis=1)).any()):
            kept.append(i)
    return np.sort(rows[np.array(order, dtype=np.intp)[kept]])


def _ends(choice: Choice, rows: Rows, metric: str | None) -> tuple[list[float | None], list[float | None]]:
    """Return the interval ends of the metric in the objective, as two columns."""
    predictions = choice.metrics[metric] if metric else choice.latency
    if predictions.ranges is None:
        return [None] * len(rows), [None] * len(rows)
    own = predictions.ranges.take(predictions.type_index[rows])
    low, high = (own.quantile(p) for p in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return _numbers(low), _numbers(high)


def _probabilities(choice: Choice, rows: Rows) -> list[float | None]:
    """Return the probability of meeting the limits of the spec, None where the model has none."""
    if choice.latency.posterior is None or not choice.bounds:
        return [None] * len(rows)
    found = [choice.probability(row) for row in rows.tolist()]
    return [None if one is None else floored(one) for one in found]


def _numbers(column: Floats) -> list[float | None]:
    return [min(value, LONGEST) if value == value else None for value in column.tolist()]
