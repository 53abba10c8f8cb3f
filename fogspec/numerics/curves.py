"""The paper's families of curves (section 2.C): latency as a sum of a curve in vCPUs and a curve in memory.

    latency = a + curve(vCPUs) + curve(GiB)

with, for one variable x: constant 0, hyperbolic b/x, logarithmic b·ln x, linear b·x, power b·x^k and exponential
b·exp(k·x); for vCPUs also the seventh, b/x + d·x, because more cores can hurt. A constant curve leaves its
variable out. Everything is a dimensionless array in base units: vCPUs, GiB, and whatever is fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# Ties go to the family that comes first: what stays positive and levels off before what falls or grows for ever.
CPU_FAMILIES = ("constant", "hyperbolic", "hyperbolic_linear", "power", "logarithmic", "exponential", "linear")
MEMORY_FAMILIES = ("constant", "hyperbolic", "power", "logarithmic", "exponential", "linear")

CURVED = {"power", "exponential"}
_LINEAR_COLUMNS = {"constant": 0, "hyperbolic_linear": 2}
_LARGEST_EXPONENT = 700.0


@dataclass(frozen=True, slots=True)
class Shape:
    """Which families make up one model."""

    cpu: str
    memory: str

    @property
    def parameters(self) -> int:
        """p: the intercept, the linear coefficients and the exponents."""
        return len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficients in the order of `columns`, then the exponents: a, b, d, e, k, j."""
        return _names(self.cpu, self.memory)

    @property
    def curved(self) -> tuple[bool, bool]:
        """Whether vCPUs and memory each carry an exponent."""
        return self.cpu in CURVED, self.memory in CURVED

    def formula(self) -> str:
        """The model as people write it, c = vCPUs and m = GiB."""
        of_cpu = [text.format(b="b", x="c", k="k") for text in _TEXTS[self.cpu]]
        of_memory = [text.format(b="e", x="m", k="j") for text in _TEXTS[self.memory]]
        return " + ".join(["a", *of_cpu, *of_memory])


_TEXTS: dict[str, tuple[str, ...]] = {
    "constant": (),
    "hyperbolic": ("{b}/{x}",),
    "hyperbolic_linear": ("{b}/{x}", "d*{x}"),
    "power": ("{b}*{x}^{k}",),
    "logarithmic": ("{b}*ln({x})",),
    "exponential": ("{b}*exp({k}*{x})",),
    "linear": ("{b}*{x}",),
}


@lru_cache(maxsize=64)
def _names(cpu: str, memory: str) -> tuple[str, ...]:
    linear = ["a", *"bd"[: _LINEAR_COLUMNS.get(cpu, 1)], *"e"[: _LINEAR_COLUMNS.get(memory, 1)]]
    exponents = [name for name, family in (("k", cpu), ("j", memory)) if family in CURVED]
    return (*linear, *exponents)


def curve(family: str, x: Floats, exponent: float = 0.0) -> list[Floats]:
    """Columns of one family at x, each shaped like x; `exponent` matters to power and exponential."""
    match family:
        case "constant":
            return []
        case "hyperbolic":
            return [1 / x]
        case "hyperbolic_linear":
            return [1 / x, x]
        case "logarithmic":
            return [np.log(x)]
        case "linear":
            return [x]
        case "power":
            return [x**exponent]
        case _:
            return [np.exp(np.clip(exponent * x, -_LARGEST_EXPONENT, _LARGEST_EXPONENT))]


def columns(shape: Shape, vcpus: ArrayLike, memory_gib: ArrayLike, exponents: Sequence[float] | Floats) -> Floats:
    """The linear columns [1, curve(vCPUs)…, curve(GiB)…], n x q; exponents in the order k, j."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    k, j = _exponents(shape, exponents)
    return np.stack([np.ones_like(c), *curve(shape.cpu, c, k), *curve(shape.memory, m, j)], axis=-1)


def predict(shape: Shape, coefficients: Sequence[float] | Floats, vcpus: ArrayLike, memory_gib: ArrayLike) -> Floats:
    """The model's value at each machine; coefficients in the order of `Shape.names`."""
    linear = len(coefficients) - sum(shape.curved)
    design = columns(shape, vcpus, memory_gib, coefficients[linear:])
    value: Floats = design @ np.asarray(coefficients[:linear], float)
    return value


def gradient(shape: Shape, coefficients: Sequence[float] | Floats, vcpus: ArrayLike, memory_gib: ArrayLike) -> Floats:
    """Derivatives of the model by its coefficients, n x p, in the order of `Shape.names`."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    linear = len(coefficients) - sum(shape.curved)
    design = columns(shape, c, m, coefficients[linear:])
    by_exponent = []
    for curved, family, x, column in (
        (shape.curved[0], shape.cpu, c, 1),
        (shape.curved[1], shape.memory, m, linear - 1),
    ):
        if curved:
            inner = np.log(x) if family == "power" else x
            by_exponent.append(coefficients[column] * design[..., column] * inner)
    return np.concatenate([design, *(column[..., None] for column in by_exponent)], axis=-1)


def exponent_grid(family: str, x: Floats, count: int) -> Floats:
    """Exponents worth trying for the values x that were sampled; empty for families without one.

    Powers from -8 to 3. Rates of the exponential such that it changes by a factor of e^0.1 to e^80 over the
    sampled range: below it is a line, above it a step.
    """
    if family == "power":
        return np.concatenate([-np.geomspace(8, 0.05, 2 * count // 3), np.geomspace(0.05, 3, count - 2 * count // 3)])
    spread = float(x.max() - x.min())
    if family != "exponential" or spread <= 0:
        return np.empty(0)
    falling = -np.geomspace(80, 0.1, 2 * count // 3)
    return np.concatenate([falling, np.geomspace(0.1, 10, count - 2 * count // 3)]) / spread


def _exponents(shape: Shape, exponents: Sequence[float] | Floats) -> tuple[float, float]:
    given = iter(exponents)
    k = next(given) if shape.curved[0] else 0.0
    j = next(given) if shape.curved[1] else 0.0
    return k, j
