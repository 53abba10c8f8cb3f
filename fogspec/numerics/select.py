"""The choice over columns: hard limits first, then the weighed sum, then fixed ties.

The objective is alpha·x/scale_x + (1 - alpha)·cost/scale_cost (the paper, section 2.E), x being latency or a
metric of the application.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
TIE = 1e-9  # relative: what processors round differently


@dataclass(frozen=True, slots=True)
class Scale:
    """What x and cost are divided by before they are weighed; both positive."""

    x: float
    cost: float


def best_attainable(values: Floats, eligible: Mask) -> float:
    """The smallest positive finite value among eligible machines; 1 where there is none.

    Adding a machine that is not the best on this axis leaves it as it is, so an irrelevant machine never
    changes the winner, as it would with min-max scaling.
    """
    usable = values[eligible & np.isfinite(values) & (values > 0)]
    return float(usable.min()) if len(usable) else 1.0


def weighed(x: Floats, cost: Floats, alpha: float, scale: Scale) -> Floats:
    """The objective of each machine, dimensionless."""
    return alpha * x / scale.x + (1 - alpha) * cost / scale.cost


def first_by(primary: Floats, cost: Floats, latency: Floats, names: NDArray[np.object_], among: Mask) -> int | None:
    """Row with the smallest `primary` among the allowed; ties by cost, then latency, then name."""
    rows = np.flatnonzero(among)
    if not len(rows):
        return None
    values = primary[rows]
    least = values.min()
    tied = rows[values <= least + TIE * abs(least)]
    return int(min(tied, key=lambda row: (cost[row], latency[row], str(names[row]), row)))


@dataclass(frozen=True, slots=True)
class Miss:
    """One limit when no machine meets them all.

    `row` is the machine that comes nearest to this limit among those that meet all others (`alone`), else
    among all; `factor` is its value over the bound: how far the limit must be relaxed.
    """

    limit: str
    bound: float
    row: int
    value: float
    factor: float
    alone: bool


def misses(values: Mapping[str, Floats], bounds: Mapping[str, float], eligible: Mask) -> tuple[Miss, ...]:
    """For each limit, the least relaxation with which some machine meets it; worst first, met ones left out.

    A limit that is met by every machine that meets the others, or by any machine when the others cannot be
    met together, has a factor of at most 1 and does not appear. Where that leaves none, because each machine breaks two
    limits or more that others meet, it is those that the nearest machine breaks, to be relaxed together.
    """
    held = {name: values[name] <= bounds[name] for name in bounds}
    found = []
    for name, bound in bounds.items():
        others = eligible.copy()
        for other, mask in held.items():
            if other != name:
                others &= mask
        alone = bool(others.any())
        rows = np.flatnonzero(others if alone else eligible)
        if not len(rows):
            continue
        row = int(rows[np.argmin(values[name][rows])])
        value = float(values[name][row])
        factor = value / bound if bound > 0 else float("inf")
        if factor > 1:
            found.append(Miss(name, bound, row, value, factor, alone))
    if not found and (closest := nearest(values, bounds, eligible)) is not None:
        over = {name: float(values[name][closest]) for name in bounds if values[name][closest] > bounds[name]}
        found = [
            Miss(name, bounds[name], closest, value, value / bounds[name] if bounds[name] > 0 else float("inf"), False)
            for name, value in over.items()
        ]
    return tuple(sorted(found, key=lambda miss: (-miss.factor, miss.limit)))


def nearest(values: Mapping[str, Floats], bounds: Mapping[str, float], eligible: Mask) -> int | None:
    """The machine whose worst excess over any limit, as a factor, is smallest."""
    rows = np.flatnonzero(eligible)
    if not len(rows) or not bounds:
        return None
    worst = np.max([values[name][rows] / max(bound, 1e-300) for name, bound in bounds.items()], axis=0)
    return int(rows[np.argmin(worst)])
