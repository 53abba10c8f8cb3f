"""The Pareto front of two quantities that are both better when smaller."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def pareto(first: ArrayLike, second: ArrayLike) -> NDArray[np.intp]:
    """Indices of the points that no other point beats on one quantity without losing on the other.

    Both have length n and hold no NaN; in order of rising `first`. Of points that are equal in both, the one
    that comes first is kept.
    """
    x, y = np.asarray(first, float), np.asarray(second, float)
    kept = _not_beaten_by_the_middle(x, y)
    x, y = x[kept], y[kept]
    order = np.lexsort((y, x))
    ahead = np.minimum.accumulate(y[order])
    better = np.ones(len(order), bool)
    better[1:] = y[order][1:] < ahead[:-1]
    return np.asarray(kept[order[better]])


def _not_beaten_by_the_middle(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.intp]:
    """Without the points that lose to one good compromise on both: most of a large catalog, before any sorting."""
    if len(x) < 2:
        return np.arange(len(x))
    with np.errstate(invalid="ignore"):
        middle = int(np.argmin(x * (1 / max(np.ptp(x), 1e-300)) + y * (1 / max(np.ptp(y), 1e-300))))
    beaten = (x >= x[middle]) & (y >= y[middle]) & ((x > x[middle]) | (y > y[middle]))
    return np.flatnonzero(~beaten)
