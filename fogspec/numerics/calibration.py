"""How far measured machines lie from what the others say of them, and by how much ranges are widened for it."""

import math
from dataclasses import dataclass

import numpy as np

from fogspec.numerics.kernels import Floats
from fogspec.numerics.normal import normal_cdf
from fogspec.numerics.servers import Shifts

LEVEL = 0.9
FEWEST = 5  # machines left out: fewer tell nothing of how often a range holds
MOST_WIDENED = 5.0  # beyond it the model is wrong, not the width of its ranges
STEPS = 24  # of a bisection of the logarithm: to six digits


@dataclass(frozen=True, slots=True)
class Calibration:
    """Of `machines` that were left out in turn, `covered` lie in the range at `LEVEL` that the others give them.

    Ranges are widened by `factor` (1 where they need not be), with which `covered_widened` do.
    """

    machines: int
    covered: int
    factor: float
    covered_widened: int

    @classmethod
    def of(cls, deviation: Floats) -> "Calibration":
        """Return it for the deviations (M,) of the machines over the ends of their ranges.

        The factor is the least tenth with which as many lie in their ranges as the level says, to the nearest number.
        """
        count, factor = len(deviation), 1.0
        if count >= FEWEST:
            factor = float(np.sort(deviation)[int(LEVEL * count + 0.5) - 1])
            # Up to the next tenth: fits without one sample differ from the closed form by up to a hundredth.
            factor = min(math.ceil(10.1 * factor) / 10, MOST_WIDENED) if factor > 1 else 1.0
        covered, widened = (int((deviation <= one).sum()) for one in (1.0, factor))
        return cls(count, covered, factor, widened)


def deviations(weights: Floats, off: Floats, variance: Floats, shifts: Shifts) -> Floats:
    """Return the factor (M,) by which the range at `LEVEL` about the mean must be stretched to reach each measured value.

    H models of these weights give each of M machines a normal distribution: `off` is its measured log-latency minus the mean,
    each (H, M). The range is that of another server.
    """
    middle = (weights * off).sum(0)
    core = np.sqrt(variance + shifts.core)
    wide = np.sqrt((weights * (variance + (off - middle) ** 2)).sum(0) + shifts.core + shifts.spread)
    low, high = np.full(len(middle), -12.0), np.full(len(middle), 12.0)
    for _ in range(STEPS):
        log = (low + high) / 2
        moved = middle * np.exp(-log)
        below = (1 - shifts.tail) * (weights * normal_cdf((moved + off - middle) / core)).sum(0)
        below += shifts.tail * normal_cdf(moved / wide)
        outside = np.maximum(below, 1 - below) > (1 + LEVEL) / 2
        low, high = np.where(outside, log, low), np.where(outside, high, log)
    return np.asarray(np.exp(high))
