"""The normal distribution for arrays, without the import time of scipy.special (ADR 0071)."""

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def normal_cdf(z: Floats) -> Floats:
    """Return P(Z <= z) with an absolute error below 1e-7.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 26.2.17.
    """
    return normal_cdf_and_density(z)[0]


def normal_cdf_and_density(z: Floats) -> tuple[Floats, Floats]:
    """Return P(Z <= z), as `normal_cdf` does, and the density at z."""
    a = np.fmin(np.abs(z), 40.0)
    t = 1 / (1 + 0.2316419 * a)
    # In place: tables of models by machines have millions of numbers.
    tail = t * 1.330274429
    for coefficient in (-1.821255978, 1.781477937, -0.356563782, 0.319381530):
        tail += coefficient
        tail *= t
    a *= a
    a *= -0.5
    density = np.exp(a, out=a)
    density /= math.sqrt(2 * math.pi)
    tail *= density
    return np.where(z > 0, 1 - tail, tail), density


def normal_quantile(p: Floats) -> Floats:
    """Return the standard normal quantile of probabilities between 0 and 1, as exact as the standard library's."""
    found, where = np.unique(p, return_inverse=True)
    return np.array([NormalDist().inv_cdf(min(max(one, 1e-15), 1 - 1e-15)) for one in found.tolist()])[where.ravel()]


def truncated_above_moments(mean: float, variance: float, bound: float) -> tuple[float, float]:
    """Return the mean and variance of a normal variable conditional on exceeding the bound.

    From 25 standard deviations above the mean both come from their asymptotic series, before the tail underflows.
    """
    sd = math.sqrt(variance)
    z = (bound - mean) / sd
    if z > 25:
        hazard, shrink = z + 1 / z - 2 / z**3 + 10 / z**5, 1 / z**2 - 6 / z**4 + 50 / z**6
    else:
        tail = 0.5 * math.erfc(z / math.sqrt(2))
        hazard = math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi) / tail
        shrink = 1 - hazard * (hazard - z)
    return mean + sd * hazard, variance * min(1.0, max(1e-6, shrink))
