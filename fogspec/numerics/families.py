"""Curve families of the paper (section 2.C): latency as a sum of a curve in vCPUs and a curve in memory.

    latency = a + curve(vCPUs) + curve(GiB)

For one variable x the families are constant 0, hyperbolic b/x, logarithmic b·ln x, linear b·x, power b·x^k and
exponential b·exp(k·x); for vCPUs there is a seventh, b/x + d·x, because more cores can hurt. A constant curve drops its
variable. Arrays are in base units: vCPUs, GiB, and the unit of the fitted values.

Fits are least squares. For each trial of the exponents the linear coefficients are solved exactly (variable projection:
Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973); the exponents come from a grid that is refined round by round, so no
start value matters. All leave-one-out folds are solved at once. Tests hold the fits to `scipy.optimize.least_squares`,
which start-up cannot afford (ADR 0071).
"""

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fogspec.numerics.kernels import Floats, quantised

Rule = Literal["loo", "r2"]

# Ties go to the earlier family: bounded, positive curves before curves that fall below zero or grow without limit.
CPU_FAMILIES = ("constant", "hyperbolic", "hyperbolic_linear", "power", "logarithmic", "exponential", "linear")
MEMORY_FAMILIES = ("constant", "hyperbolic", "power", "logarithmic", "exponential", "linear")
NONLINEAR = {"power", "exponential"}

GRID = 36  # exponents in the first round
ROUNDS = 9
REFINED = 7  # exponents in every later round
_LARGEST_EXPONENT = 700.0
_LINEAR_COLUMNS = {"constant": 0, "hyperbolic_linear": 2}
_LEVELS = {"constant": 1, "hyperbolic_linear": 3, "power": 3, "exponential": 3}

# Errors this close do not separate families: a fraction of the smallest error, and a floor for rounding.
TIE_FRACTION = 0.01
TIE_FLOOR = 1e-6
WEAK_ERROR = 0.25


@dataclass(frozen=True, slots=True)
class Shape:
    """The pair of families of one model."""

    cpu: str
    memory: str

    @property
    def parameters(self) -> int:
        """Number of parameters p: the intercept, the linear coefficients and the exponents."""
        return len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients in the order of `columns`, then of the exponents: a, b, d, e, k, j."""
        return _names(self.cpu, self.memory)

    @property
    def nonlinear(self) -> tuple[bool, bool]:
        """Flags: the curve in vCPUs, and the curve in memory, has an exponent."""
        return self.cpu in NONLINEAR, self.memory in NONLINEAR

    def formula(self) -> str:
        """Return the model as text, with c = vCPUs and m = GiB."""
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
    exponents = [name for name, family in (("k", cpu), ("j", memory)) if family in NONLINEAR]
    return (*linear, *exponents)


def curve(family: str, x: Floats, exponent: float | Floats = 0.0) -> list[Floats]:
    """Return the columns of one family at x, each shaped like x, by `exponent` if it has one; ValueError if it has no curve."""
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
        case "exponential":
            return [np.exp(np.clip(exponent * x, -_LARGEST_EXPONENT, _LARGEST_EXPONENT))]
        case _:
            raise ValueError(f"{family} is not a curve family")


def columns(shape: Shape, vcpus: ArrayLike, memory_gib: ArrayLike, exponents: Sequence[float] | Floats) -> Floats:
    """Return the linear columns [1, curve(vCPUs)…, curve(GiB)…], (..., q); exponents in the order k, j."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    given = iter(exponents)
    k, j = (next(given) if nonlinear else 0.0 for nonlinear in shape.nonlinear)
    return _side_by_side([np.ones_like(c), *curve(shape.cpu, c, k), *curve(shape.memory, m, j)], c.shape)


def _side_by_side(found: Sequence[Floats], rows: tuple[int, ...]) -> Floats:
    """Return columns that broadcast to `rows` as the last axis of one array, which np.stack takes longer for."""
    whole = np.empty((*rows, len(found)))
    for at, column in enumerate(found):
        whole[..., at] = column
    return whole


def predict(shape: Shape, coefficients: Sequence[float] | Floats, vcpus: ArrayLike, memory_gib: ArrayLike) -> Floats:
    """Return the model's value at each machine; coefficients in the order of `Shape.names`."""
    linear = len(coefficients) - sum(shape.nonlinear)
    design = columns(shape, vcpus, memory_gib, coefficients[linear:])
    value: Floats = design @ np.asarray(coefficients[:linear], float)
    return value


def gradient(shape: Shape, coefficients: Sequence[float] | Floats, vcpus: ArrayLike, memory_gib: ArrayLike) -> Floats:
    """Return the derivatives of the model by its coefficients, (n, p), in the order of `Shape.names`."""
    c, m = np.asarray(vcpus, float), np.asarray(memory_gib, float)
    linear = len(coefficients) - sum(shape.nonlinear)
    design = columns(shape, c, m, coefficients[linear:])
    by_exponent = []
    for nonlinear, family, x, column in (
        (shape.nonlinear[0], shape.cpu, c, 1),
        (shape.nonlinear[1], shape.memory, m, linear - 1),
    ):
        if nonlinear:
            inner = np.log(x) if family == "power" else x
            by_exponent.append(coefficients[column] * design[..., column] * inner)
    return np.concatenate([design, *(column[..., None] for column in by_exponent)], axis=-1)


def exponent_grid(family: str, x: Floats, count: int) -> Floats:
    """Return `count` exponents to try for the sampled values x; empty for families without an exponent.

    Powers range from -8 to 3. Rates of the exponential change it by a factor of e^0.1 to e^80 over the sampled range: a
    smaller rate is a line, a larger one a step.
    """
    if family == "power":
        return np.concatenate([-np.geomspace(8, 0.05, 2 * count // 3), np.geomspace(0.05, 3, count - 2 * count // 3)])
    extent = float(x.max() - x.min())
    if family != "exponential" or extent <= 0:
        return np.empty(0)
    falling = -np.geomspace(80, 0.1, 2 * count // 3)
    return np.concatenate([falling, np.geomspace(0.1, 10, count - 2 * count // 3)]) / extent


@dataclass(frozen=True, slots=True)
class Fit:
    """One pair of families fitted to n samples.

    `loo` holds, for each sample, the relative error (predicted - measured) / |measured| of the fit without that sample,
    NaN where that fit does not exist.
    """

    shape: Shape
    coefficients: tuple[float, ...]
    n: int
    r2: float
    loo: tuple[float, ...]

    @property
    def p(self) -> int:
        """Number of parameters."""
        return self.shape.parameters

    @property
    def eligible(self) -> bool:
        """Flag: there are at least two more samples than parameters, and every leave-one-out fit exists."""
        return self.n >= self.p + 2 and all(np.isfinite(self.loo))

    @property
    def loo_mean(self) -> float:
        """Mean absolute leave-one-out error, relative; NaN where a leave-one-out fit does not exist."""
        return float(np.mean(np.abs(self.loo)))

    @property
    def loo_median(self) -> float:
        """Median absolute leave-one-out error, relative; NaN where a leave-one-out fit does not exist."""
        # Not np.median, whose first call imports numpy.ma.
        return statistics.median(map(abs, self.loo)) if all(np.isfinite(self.loo)) else float("nan")

    @property
    def loo_max(self) -> float:
        """Largest absolute leave-one-out error, relative; NaN where a leave-one-out fit does not exist."""
        return float(np.max(np.abs(self.loo)))

    def predict(self, vcpus: ArrayLike, memory_gib: ArrayLike) -> Floats:
        """Return the curve's value at each machine."""
        return predict(self.shape, self.coefficients, vcpus, memory_gib)


def fit_all(vcpus: ArrayLike, memory_gib: ArrayLike, latency_s: ArrayLike) -> tuple[Fit, ...]:
    """Fit every pair of families that n samples determine, in the order of `CPU_FAMILIES`, then `MEMORY_FAMILIES`.

    A pair is determined by p < n samples with enough distinct vCPUs and GiB; the constant always is. All three arrays have
    shape (n,), n >= 1. Raise ValueError for unequal lengths, no sample, a value that is not finite, or vCPUs or memory
    that are not positive.
    """
    c, m, y = (np.asarray(column, float) for column in (vcpus, memory_gib, latency_s))
    if not c.shape == m.shape == y.shape or y.ndim != 1 or not len(y):
        raise ValueError("vCPUs, memory and values must be equally long, and at least one")
    if not (np.isfinite(c).all() and np.isfinite(m).all() and np.isfinite(y).all()):
        raise ValueError("vCPUs, memory and values must be finite numbers")
    if (c <= 0).any() or (m <= 0).any():
        raise ValueError("vCPUs and memory must be positive")
    keep = np.vstack([np.ones(len(y), bool), ~np.eye(len(y), dtype=bool)])
    levels = np.array([[len(set(x[rows].tolist())) for x in (c, m)] for rows in keep])
    fits = (
        _fit(Shape(cpu, memory), c, m, y, keep=keep, levels=levels)
        for cpu, memory in itertools.product(CPU_FAMILIES, MEMORY_FAMILIES)
    )
    return tuple(fit for fit in fits if fit is not None)


def select(fits: Sequence[Fit], rule: Rule = "loo") -> Fit:
    """Return the fit to use.

    `loo` takes the smallest mean leave-one-out error among fits with n >= p + 2; ties go to fewer parameters, then to the
    order of `CPU_FAMILIES` and `MEMORY_FAMILIES`; a memory curve must lower the error of the best fit without one. Without
    an eligible fit it takes the constant. `r2` is the paper's rule (section 2.C): the largest R² among its own six
    families. Raise ValueError for no fits.
    """
    if not fits:
        raise ValueError("nothing was fitted")
    if rule == "r2":
        of_paper = [fit for fit in fits if fit.shape.cpu != "hyperbolic_linear" and np.isfinite(fit.r2)]
        return max(of_paper, key=lambda fit: (round(fit.r2, 9), -fit.p), default=_constant(fits))
    eligible = [fit for fit in fits if fit.eligible]
    if not eligible:
        return _constant(fits)
    without = [fit for fit in eligible if fit.shape.memory == "constant"]
    best = _simplest(without or eligible)
    with_memory = [fit for fit in eligible if fit.shape.memory != "constant"]
    if with_memory and without:
        rival = _simplest(with_memory)
        if rival.loo_mean < best.loo_mean * (1 - TIE_FRACTION) - TIE_FLOOR:
            return rival
    return best


def _constant(fits: Sequence[Fit]) -> Fit:
    return min(fits, key=lambda fit: fit.p)


def _simplest(fits: Sequence[Fit]) -> Fit:
    least = min(fit.loo_mean for fit in fits)
    tied = [fit for fit in fits if fit.loo_mean <= least * (1 + TIE_FRACTION) + TIE_FLOOR]
    return min(
        tied, key=lambda fit: (fit.p, CPU_FAMILIES.index(fit.shape.cpu), MEMORY_FAMILIES.index(fit.shape.memory))
    )


def _fit(
    shape: Shape, c: Floats, m: Floats, y: Floats, *, keep: NDArray[np.bool_], levels: NDArray[np.intp]
) -> Fit | None:
    """Fit all samples (the first row of `keep`) and every fold; return None if all samples do not determine the fit."""
    needed = (_LEVELS.get(shape.cpu, 2), _LEVELS.get(shape.memory, 2))
    determined = np.asarray((levels >= np.array(needed)).all(axis=1))
    if not determined[0] or (shape.parameters > 1 and shape.parameters >= len(y)):
        return None
    exponents = _best_exponents(shape, c, m, y, keep)
    linear, full_rank = _solve(_designs(shape, c, m, exponents), y, keep)
    if not full_rank[0]:
        return None
    coefficients = quantised(_polish(shape, np.concatenate([linear[0], exponents[0]]), c, m, y))
    residuals = y - predict(shape, coefficients, c, m)
    total = float(np.sum((y - y.mean()) ** 2))
    r2 = 1 - float(np.sum(residuals**2)) / total if total > 0 else float("nan")
    loo = _leave_one_out(shape, c, m, y, np.column_stack([linear, exponents])[1:])
    loo[~(determined & full_rank)[1:]] = np.nan
    return Fit(
        shape=shape, coefficients=tuple(coefficients.tolist()), n=len(y), r2=r2, loo=tuple(quantised(loo).tolist())
    )


def _leave_one_out(shape: Shape, c: Floats, m: Floats, y: Floats, folds: Floats) -> Floats:
    """Return the relative error of each sample under the fit without it; `folds` holds those fits' coefficients, (n, p)."""
    linear = folds.shape[1] - sum(shape.nonlinear)
    given = iter(folds[:, linear:].T)
    k, j = (next(given) if nonlinear else 0.0 for nonlinear in shape.nonlinear)
    design = _side_by_side([np.ones_like(c), *curve(shape.cpu, c, k), *curve(shape.memory, m, j)], c.shape)
    predicted = np.einsum("fq,fq->f", design, folds[:, :linear])
    return np.asarray((predicted - y) / np.where(y == 0, 1.0, np.abs(y)))


def _designs(shape: Shape, c: Floats, m: Floats, exponents: Floats) -> Floats:
    """Return the linear columns of every fold, (folds, n, q)."""
    if not any(shape.nonlinear):
        one = columns(shape, c, m, ())
        return np.broadcast_to(one, (len(exponents), *one.shape))
    given = iter(exponents.T)
    k, j = (next(given)[:, None] if nonlinear else 0.0 for nonlinear in shape.nonlinear)
    found = [np.ones_like(c), *curve(shape.cpu, c, k), *curve(shape.memory, m, j)]
    return _side_by_side(found, (len(exponents), len(c)))


def _solve(designs: Floats, y: Floats, keep: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
    """Solve the least squares of every fold: coefficients (folds, q), and a flag for each fold of full rank."""
    masked = designs * keep[:, :, None]
    scale = np.linalg.norm(masked, axis=1, keepdims=True)
    scale[scale == 0] = 1.0
    u, s, vt = np.linalg.svd(masked / scale, full_matrices=False)
    full_rank = (s[:, -1] > 1e-10 * s[:, 0]) if s.shape[1] == designs.shape[2] else np.zeros(len(s), bool)
    inverse = np.where(s > 1e-12 * s[:, :1], 1 / np.maximum(s, 1e-300), 0.0)
    projected = np.einsum("fnq,fn->fq", u, keep * y) * inverse
    return np.einsum("fqp,fq->fp", vt, projected) / scale[:, 0, :], full_rank


def _best_exponents(shape: Shape, c: Floats, m: Floats, y: Floats, keep: NDArray[np.bool_]) -> Floats:
    """Return the exponents of every fold, (folds, 0, 1 or 2), with the smallest sum of squares on the refined grid."""
    nonlinear = [(family, x) for family, x in ((shape.cpu, c), (shape.memory, m)) if family in NONLINEAR]
    if not nonlinear:
        return np.empty((len(keep), 0))
    flat = Shape(*("constant" if family in NONLINEAR else family for family in (shape.cpu, shape.memory)))
    basis = np.linalg.qr(columns(flat, c, m, ()) * keep[:, :, None]).Q
    target = _residual(np.broadcast_to(y, keep.shape)[:, None, :] * keep[:, None, :], basis)[:, 0]
    grids = [np.tile(exponent_grid(family, x, GRID), (len(keep), 1)) for family, x in nonlinear]
    best = np.empty((len(keep), len(nonlinear)))
    for _ in range(ROUNDS):
        tried = [
            _residual(_column(family, x, grid) * keep[:, None, :], basis)
            for (family, x), grid in zip(nonlinear, grids, strict=True)
        ]
        at = _most_explained(tried, target)
        grids = [_refined(grid, at[:, axis]) for axis, grid in enumerate(grids)]
        best = np.stack([grid[:, REFINED // 2] for grid in grids], axis=1)
    return best


def _column(family: str, x: Floats, grid: Floats) -> Floats:
    """Return the family's column for each exponent, (folds, exponents, n), scaled to a maximum of one."""
    middle = np.exp(np.mean(np.log(x))) if family == "power" else np.max(x)
    inner = np.log(x / middle) if family == "power" else x - middle
    exponent = grid[:, :, None] * inner
    column: Floats = np.exp(exponent - np.max(exponent, axis=2, keepdims=True))
    return column


def _residual(values: Floats, basis: Floats) -> Floats:
    """Return values (folds, k, n) minus their projection on each fold's orthonormal basis (folds, n, q)."""
    left: Floats = values - (values @ basis) @ np.swapaxes(basis, 1, 2)
    return left


def _most_explained(tried: Sequence[Floats], target: Floats) -> NDArray[np.intp]:
    """Return the indices (folds, exponents) of the columns that explain the largest part of the target."""
    first = tried[0]
    a = np.sum(first * first, axis=2)
    u = np.einsum("fkn,fn->fk", first, target)
    with np.errstate(divide="ignore", invalid="ignore"):
        if len(tried) == 1:
            explained = np.where(a > 1e-20, u**2 / a, -1.0)
            return np.asarray(np.argmax(explained, axis=1)[:, None])
        second = tried[1]
        b = np.sum(second * second, axis=2)
        v = np.einsum("fkn,fn->fk", second, target)
        cross = first @ np.swapaxes(second, 1, 2)
        determinant = a[:, :, None] * b[:, None, :] - cross**2
        explained = (
            b[:, None, :] * u[:, :, None] ** 2
            - 2 * cross * u[:, :, None] * v[:, None, :]
            + a[:, :, None] * v[:, None, :] ** 2
        ) / determinant
        explained = np.where(determinant > 1e-9 * a[:, :, None] * b[:, None, :], explained, -1.0)
    flat = np.argmax(explained.reshape(len(explained), -1), axis=1)
    return np.stack(np.unravel_index(flat, explained.shape[1:]), axis=1)


def _refined(grid: Floats, at: NDArray[np.intp]) -> Floats:
    """Return a finer grid of `REFINED` exponents between the neighbours of the best exponent of each fold."""
    rows = np.arange(len(grid))
    middle = grid[rows, at]
    low = grid[rows, np.maximum(at - 1, 0)]
    high = grid[rows, np.minimum(at + 1, grid.shape[1] - 1)]
    half = REFINED // 2
    steps = np.arange(1, half + 1) / (half + 1)
    below = middle[:, None] - (middle - low)[:, None] * steps[::-1]
    above = middle[:, None] + (high - middle)[:, None] * steps
    return np.concatenate([below, middle[:, None], above], axis=1)


def _polish(shape: Shape, start: Floats, c: Floats, m: Floats, y: Floats) -> Floats:
    """Apply Gauss-Newton steps to a good start while they lower the sum of squares."""
    best, coefficients, trial = np.inf, start, start
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(8 if any(shape.nonlinear) else 1):
            residuals = y - predict(shape, trial, c, m)
            squares = float(residuals @ residuals)
            jacobian = gradient(shape, trial, c, m)
            scale = np.linalg.norm(jacobian, axis=0)
            if not squares < best or not np.isfinite(scale).all() or (scale == 0).any():
                break
            best, coefficients = squares, trial
            trial = trial + np.linalg.lstsq(jacobian / scale, residuals, rcond=1e-12)[0] / scale
    return coefficients
