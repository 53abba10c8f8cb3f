"""The Pareto front of two quantities that are both better when smaller."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def pareto(first: ArrayLike, second: ArrayLike) -> NDArray[np.intp]:
    """Indices of the points that no other point beats on one quantity without losing on the other.

    Both have length n and hold no NaN; in order of rising `first`. Of points that are equal in both, the one
    that comes first is kept.
    """
    x, y = np.asarray(first, float), np.asarray(second, float)
    order = np.lexsort((y, x))
    ahead = np.minimum.accumulate(y[order])
    better = np.ones(len(order), bool)
    better[1:] = y[order][1:] < ahead[:-1]
    return order[better]
