"""Student's t distribution for whole degrees of freedom, without scipy: its import costs more than the rest of a command."""

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fogspec.numerics.gaussian import normal_cdf

_NORMAL_FROM = 200


def cdf(t: ArrayLike, dof: int) -> NDArray[np.float64]:
    """P(T <= t), shaped like t, for dof >= 1; the finite sums of Abramowitz and Stegun, 26.7.3 and 26.7.4.

    From 200 degrees of freedom on, the normal distribution (wrong by less than 0.001). Raises ValueError for
    dof < 1.
    """
    if dof < 1:
        raise ValueError("degrees of freedom must be at least 1")
    value = np.asarray(t, float)
    if dof >= _NORMAL_FROM:
        return normal_cdf(value)
    theta = np.arctan(value / math.sqrt(dof))
    sine, cosine2 = np.sin(theta), np.cos(theta) ** 2
    first, start = (np.cos(theta), 2) if dof % 2 else (np.ones_like(theta), 1)
    term, total = first, np.where(dof > 1, first, 0.0)
    for i in range(start, dof - 1, 2):
        term = term * cosine2 * (i / (i + 1))
        total = total + term
    inside = (theta + sine * total) * 2 / math.pi if dof % 2 else sine * total
    return 0.5 * (1 + inside)


def quantile(share: float, dof: int) -> float:
    """t with P(T <= t) = share, for 0 < share < 1; by bisection, to 1e-12 of its size."""
    if not 0 < share < 1:
        raise ValueError("a quantile is of a share between 0 and 1")
    if dof >= _NORMAL_FROM:
        return NormalDist().inv_cdf(share)
    low, high = -1.0, 1.0
    while cdf(low, dof) > share:
        low *= 2
    while cdf(high, dof) < share:
        high *= 2
    while high - low > 1e-12 * max(1.0, abs(low)):
        middle = (low + high) / 2
        low, high = (middle, high) if cdf(middle, dof) < share else (low, middle)
    return (low + high) / 2
