"""Continuous relaxation of the paper (section 2.E): real-valued vCPUs and memory, then the admissible nearest neighbours.

The relaxed problem has two variables and is not convex. A grid in (log2 vCPU, log2 GiB per vCPU) that is narrowed round by
round finds the optimum without a start value or derivatives; `scipy.optimize` refines it. Only feasible points are returned.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Surface = Callable[[Floats, Floats], Floats]

POINTS = 41  # per axis and round
ROUNDS = 40
SHRINK = 0.6
ROUNDING = 1e-12  # slack in log2 GiB for what rounding of the logarithms leaves
MARGIN = 1e-9  # slack that refined points keep, so rounding does not make them infeasible
TIE = 1e-9  # relative improvement from which on a refined point replaces that of the grid


@dataclass(frozen=True, slots=True)
class Box:
    """Bounds of the relaxed problem: vCPUs, GiB, and GiB per vCPU, each (low, high) and positive."""

    vcpus: tuple[float, float]
    memory_gib: tuple[float, float]
    memory_per_vcpu: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Optimum:
    """The continuous optimum, which in general is not an available machine."""

    vcpus: float
    memory_gib: float
    value: float


def box_of(vcpus: ArrayLike, memory_gib: ArrayLike) -> Box:
    """Return the smallest box that contains the given machines."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    low_high = [(float(x.min()), float(x.max())) for x in (c, m, m / c)]
    return Box(*low_high)


def price_surface(vcpus: ArrayLike, memory_gib: ArrayLike, price_usd_per_hour: ArrayLike) -> Surface:
    """Return the price as a plane in vCPUs and GiB by least squares; only for points between existing machines."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    design = np.column_stack([np.ones_like(c), c, m])
    plane = np.linalg.lstsq(design, np.asarray(price_usd_per_hour, float), rcond=None)[0]
    return lambda x, y: plane[0] + plane[1] * x + plane[2] * y


def minimise(objective: Surface, slack: Surface, box: Box, *, refine: bool = True) -> Optimum | None:
    """Return the smallest objective over the feasible part of the box, None if no feasible point is found.

    `objective` takes arrays of vCPUs and GiB of equal shape (...) and returns (...); `slack` returns (k, ...), the
    dimensionless slack of k constraints, which is at least 0 where they are met. Without `refine` the result is that of the
    grid alone, which does not import scipy.
    """
    problem = _Problem(objective, slack, box)
    z, feasible = problem.search()
    if refine:
        z, feasible = problem.refined(z, feasible)
    if not feasible:
        return None
    return Optimum(float(2 ** z[0]), float(2 ** (z[0] + z[1])), float(problem.value(z)))


@dataclass(frozen=True, slots=True)
class _Problem:
    """The relaxed problem in the variables z = (log2 vCPU, log2 GiB per vCPU)."""

    objective: Surface
    slack: Surface
    box: Box

    @property
    def bounds(self) -> Floats:
        """Lower and upper bounds of z, (2, 2)."""
        return np.log2([self.box.vcpus, self.box.memory_per_vcpu]).T

    def value(self, z: Floats) -> Floats:
        """Return the objective at z (2, ...)."""
        return self.objective(np.exp2(z[0]), np.exp2(z[0] + z[1]))

    def slacks(self, z: Floats) -> Floats:
        """Return the slack (k + 2, ...) of the constraints and of the bounds of memory."""
        low, high = np.log2(self.box.memory_gib)
        memory = z[0] + z[1]
        own = self.slack(np.exp2(z[0]), np.exp2(memory))
        return np.concatenate([own, [memory - low + ROUNDING, high - memory + ROUNDING]])

    def search(self) -> tuple[Floats, bool]:
        """Return the best point of the narrowed grids and True; without one, the point of least violation and False."""
        low, high = self.bounds
        middle, half, least = (low + high) / 2, (high - low) / 2, np.inf
        for i in range(ROUNDS):
            reach = half * SHRINK**i
            axes = np.linspace(np.maximum(middle - reach, low), np.minimum(middle + reach, high), POINTS, axis=1)
            points = np.array(np.meshgrid(*axes, indexing="ij")).reshape(2, -1)
            slacks = self.slacks(points)
            value = np.where((slacks >= 0).all(axis=0), self.value(points), np.inf)
            at = int(np.argmin(value))
            if value[at] < least:
                least, middle = float(value[at]), points[:, at]
            if not np.isfinite(least):
                return points[:, int(np.argmax(np.nan_to_num(slacks, nan=-np.inf).min(axis=0)))], False
        return middle, True

    def refined(self, start: Floats, feasible: bool) -> tuple[Floats, bool]:
        """Return the optimum that SLSQP (Kraft 1988) reaches from the start if it is feasible and better, else the start."""
        # Imported here: the import takes more time than most commands (ADR 0071).
        from scipy.optimize import Bounds, NonlinearConstraint, minimize

        low, high = self.bounds
        least = float(self.value(start)) if feasible else np.inf
        scale = abs(least) if 0 < abs(least) < np.inf else 1.0

        def scaled(z: Floats) -> float:
            return float(self.value(z)) / scale

        with np.errstate(all="ignore"):
            found = minimize(
                scaled,
                start,
                method="SLSQP",
                bounds=Bounds(low, high),
                constraints=NonlinearConstraint(self.slacks, MARGIN, np.inf),
                options={"ftol": 1e-12, "maxiter": 200},
            )
            z = np.clip(found.x, low, high)
            better = bool((self.slacks(z) >= 0).all()) and scaled(z) < least / scale - TIE
        return (z, True) if better else (start, feasible)


def neighbours(optimum: Optimum, vcpus: ArrayLike, memory_gib: ArrayLike) -> NDArray[np.intp]:
    """Return the rows of the admissible machines around the optimum: in each quadrant, the nearest in log2 vCPU and GiB.

    Nearest first; machines of equal shape are all included. The first row is the authors' plain rounding.
    """
    du = np.log2(np.asarray(vcpus, float) / optimum.vcpus)
    dv = np.log2(np.asarray(memory_gib, float) / optimum.memory_gib)
    distance = np.round(np.hypot(du, dv), 9)
    kept = np.zeros(len(distance), bool)
    for quadrant in ((du <= 0) & (dv <= 0), (du <= 0) & (dv > 0), (du > 0) & (dv <= 0), (du > 0) & (dv > 0)):
        if quadrant.any():
            kept |= quadrant & (distance == distance[quadrant].min())
    rows = np.flatnonzero(kept)
    return rows[np.argsort(distance[rows], kind="stable")]
