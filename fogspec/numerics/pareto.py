"""The Pareto front of two quantities that are both better when smaller."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def pareto(first: ArrayLike, second: ArrayLike) -> NDArray[np.intp]:
    """Return the indices of the non-dominated points in ascending order of `first`.

    Both quantities have shape (n,) without NaN. Of points equal in both, the first is kept.
    """
    x, y = np.asarray(first, float), np.asarray(second, float)
    kept = _not_dominated_by_compromise(x, y)
    x, y = x[kept], y[kept]
    order = np.lexsort((y, x))
    ahead = np.minimum.accumulate(y[order])
    better = np.ones(len(order), bool)
    better[1:] = y[order][1:] < ahead[:-1]
    return np.asarray(kept[order[better]])


def _not_dominated_by_compromise(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the indices without the points that one good compromise dominates: it removes most points before sorting."""
    if len(x) < 2:
        return np.arange(len(x))
    with np.errstate(invalid="ignore"):
        middle = int(np.argmin(x * (1 / max(np.ptp(x), 1e-300)) + y * (1 / max(np.ptp(y), 1e-300))))
    dominated = (x >= x[middle]) & (y >= y[middle]) & ((x > x[middle]) | (y > y[middle]))
    return np.flatnonzero(~dominated)
