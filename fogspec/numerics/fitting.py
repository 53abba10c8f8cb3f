"""Which fit to trust, and how far: selection by leave-one-out error, prediction intervals, warning signs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fogspec.numerics import curves, student
from fogspec.numerics.curves import CPU_FAMILIES, MEMORY_FAMILIES
from fogspec.numerics.families import Fit

Floats = NDArray[np.float64]
Rule = Literal["loo", "r2"]

# Errors this close say nothing about which family is better: a share of the smallest, and what rounding leaves.
TIE_SHARE = 0.01
TIE_FLOOR = 1e-6
WEAK_ERROR = 0.25


def select(fits: Sequence[Fit], rule: Rule = "loo") -> Fit:
    """The fit to use.

    `loo` takes the smallest mean leave-one-out error among fits with n >= p + 2; ties go to fewer parameters,
    then to the order of `CPU_FAMILIES` and `MEMORY_FAMILIES`; a memory curve must lower the error of the best
    fit without one. Where no fit is eligible, the constant. `r2` is the paper's rule (section 2.C): the
    largest R² among its own six families. Raises ValueError without fits.
    """
    if not fits:
        raise ValueError("nothing was fitted")
    if rule == "r2":
        own = [fit for fit in fits if fit.shape.cpu != "hyperbolic_linear" and np.isfinite(fit.r2)]
        return max(own, key=lambda fit: (round(fit.r2, 9), -fit.p), default=_constant(fits))
    eligible = [fit for fit in fits if fit.eligible]
    if not eligible:
        return _constant(fits)
    without = [fit for fit in eligible if fit.shape.memory == "constant"]
    best = _simplest(without or eligible)
    with_memory = [fit for fit in eligible if fit.shape.memory != "constant"]
    if with_memory and without:
        rival = _simplest(with_memory)
        if rival.loo_mean < best.loo_mean * (1 - TIE_SHARE) - TIE_FLOOR:
            return rival
    return best


def _constant(fits: Sequence[Fit]) -> Fit:
    return min(fits, key=lambda fit: fit.p)


def _simplest(fits: Sequence[Fit]) -> Fit:
    least = min(fit.loo_mean for fit in fits)
    tied = [fit for fit in fits if fit.loo_mean <= least * (1 + TIE_SHARE) + TIE_FLOOR]
    return min(tied, key=_order)


def _order(fit: Fit) -> tuple[int, int, int]:
    return fit.p, CPU_FAMILIES.index(fit.shape.cpu), MEMORY_FAMILIES.index(fit.shape.memory)


@dataclass(frozen=True, slots=True)
class Spread:
    """How wrong a fit is expected to be: what a prediction's interval is made of.

    `relative` is the root mean square of the relative leave-one-out errors, `absolute` the same in the unit of
    the values, `residual` the standard deviation about the curve; `dof` = n - p.
    """

    relative: float
    absolute: float
    residual: float
    dof: int


def spread_of(fit: Fit, values: ArrayLike) -> Spread | None:
    """The spread of a fit over the n values it was fitted to; None where leaving one out is impossible."""
    y = np.asarray(values, float)
    loo = np.asarray(fit.loo)
    dof = fit.n - fit.p
    if dof < 1 or not np.isfinite(loo).all():
        return None
    residual = float(np.sqrt(np.sum(np.square(fit.residuals)) / dof))
    absolute = float(np.sqrt(np.mean((loo * np.where(y == 0, 1.0, np.abs(y))) ** 2)))
    return Spread(float(np.sqrt(np.mean(loo**2))), absolute, residual, dof)


def deviations(
    shape: curves.Shape, coefficients: Sequence[float] | Floats, covariance: ArrayLike, spread: Spread,
    vcpus: ArrayLike, memory_gib: ArrayLike, *, relative: bool,
) -> Floats:  # fmt: skip
    """Standard deviation of the prediction at each machine: a share of it if `relative`, else in its unit.

    The leave-one-out error holds for machines like the sampled ones; what the coefficients' own uncertainty
    adds at this machine (the delta method) comes on top.
    """
    slope = curves.gradient(shape, coefficients, vcpus, memory_gib)
    leverage = np.einsum("...i,ij,...j->...", slope, np.asarray(covariance, float), slope)
    of_curve = spread.residual * np.sqrt(np.maximum(leverage, 0))
    if not relative:
        return np.asarray(np.hypot(spread.absolute, of_curve))
    value = np.abs(curves.predict(shape, coefficients, vcpus, memory_gib))
    with np.errstate(divide="ignore"):
        return np.asarray(np.hypot(spread.relative, np.where(value > 0, of_curve / value, np.inf)))


def interval(
    value: ArrayLike, deviation: ArrayLike, dof: int, level: float, *, relative: bool
) -> tuple[Floats, Floats]:
    """Two-sided prediction interval at `level`: value·exp(±t·sd) if the deviation is relative, else value ± t·sd."""
    middle, width = np.asarray(value, float), student.quantile((1 + level) / 2, dof) * np.asarray(deviation, float)
    if relative:
        with np.errstate(over="ignore"):
            return middle * np.exp(-width), middle * np.exp(width)
    return middle - width, middle + width


def probability_below(bound: ArrayLike, value: ArrayLike, deviation: ArrayLike, dof: int, *, relative: bool) -> Floats:
    """Probability that the truth is at most `bound`, under the distribution whose interval `interval` gives."""
    limit, middle, sd = np.broadcast_arrays(*(np.asarray(part, float) for part in (bound, value, deviation)))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.log(limit / middle) if relative else limit - middle
        z = np.where(sd > 0, distance / sd, np.where(distance >= 0, np.inf, -np.inf))
        z = np.where(np.isposinf(limit), np.inf, z)
    return np.where(np.isnan(z), 0.0, student.cdf(np.clip(z, -1e9, 1e9), dof))
