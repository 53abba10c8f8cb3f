"""Which fit to trust: selection by leave-one-out error, or by R² as the paper has it."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from fogspec.numerics.curves import CPU_FAMILIES, MEMORY_FAMILIES
from fogspec.numerics.families import Fit

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
