"""The paper's optimiser (section 2.E): vCPUs and memory as real numbers, then the admissible nearest neighbours.

The relaxed problem has two variables, so it is solved on a grid in (log2 vCPU, log2 GiB per vCPU) that is
narrowed round by round: no start value, no derivative, and a point that breaks a limit is never an answer.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Surface = Callable[[Floats, Floats], Floats]

POINTS = 41
ROUNDS = 40
SHRINK = 0.6


@dataclass(frozen=True, slots=True)
class Box:
    """Bounds of the relaxed problem: vCPUs, GiB, and GiB per vCPU, each (low, high) and positive."""

    vcpus: tuple[float, float]
    memory_gib: tuple[float, float]
    memory_per_vcpu: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Optimum:
    """The continuous optimum: not a machine that anybody rents."""

    vcpus: float
    memory_gib: float
    value: float


def box_of(vcpus: ArrayLike, memory_gib: ArrayLike) -> Box:
    """The smallest box around the given machines."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    low_high = [(float(x.min()), float(x.max())) for x in (c, m, m / c)]
    return Box(*low_high)


def price_surface(vcpus: ArrayLike, memory_gib: ArrayLike, price_usd_per_hour: ArrayLike) -> Surface:
    """Price as a plane in vCPUs and GiB, by least squares: only for between the machines that exist."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    design = np.column_stack([np.ones_like(c), c, m])
    plane = np.linalg.lstsq(design, np.asarray(price_usd_per_hour, float), rcond=None)[0]
    return lambda x, y: plane[0] + plane[1] * x + plane[2] * y


def minimise(objective: Surface, feasible: Callable[[Floats, Floats], NDArray[np.bool_]], box: Box) -> Optimum | None:
    """The smallest objective over the feasible part of the box; None where no grid point is feasible.

    `objective` and `feasible` take arrays of vCPUs and GiB of equal shape.
    """
    low = np.log2([box.vcpus[0], box.memory_per_vcpu[0]])
    high = np.log2([box.vcpus[1], box.memory_per_vcpu[1]])
    middle, half = (low + high) / 2, (high - low) / 2
    best: Optimum | None = None
    for _ in range(ROUNDS):
        axes = [
            np.linspace(max(a - h, x), min(a + h, y), POINTS)
            for a, h, x, y in zip(middle, half, low, high, strict=True)
        ]
        u, v = np.meshgrid(*axes, indexing="ij")
        c, m = 2**u, 2 ** (u + v)
        slack = 1 + 1e-12
        inside = (m >= box.memory_gib[0] / slack) & (m <= box.memory_gib[1] * slack) & feasible(c, m)
        value = np.where(inside, objective(c, m), np.inf)
        at = np.unravel_index(np.argmin(value), value.shape)
        if np.isfinite(value[at]) and (best is None or value[at] < best.value):
            best = Optimum(float(c[at]), float(m[at]), float(value[at]))
        if best is None:
            return None
        middle = np.array([np.log2(best.vcpus), np.log2(best.memory_gib / best.vcpus)])
        half = half * SHRINK
    return best


def neighbours(optimum: Optimum, vcpus: ArrayLike, memory_gib: ArrayLike) -> NDArray[np.intp]:
    """Rows of the admissible machines about the optimum: in each quadrant, the nearest in log2 vCPU and log2 GiB.

    Nearest first; all machines of an equal shape are there. The first is the plain rounding of the authors.
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
