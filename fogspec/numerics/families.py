"""Least squares over every pair of families, with leave-one-out errors: all that few samples can say.

The linear coefficients are solved exactly for each trial of the exponents (variable projection: Golub and
Pereyra, SIAM J. Numer. Anal. 10(2), 1973); the exponents come from a grid that is narrowed round by round, so
that no start value matters. All folds of the leave-one-out are worked on at once.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fogspec.numerics import curves
from fogspec.numerics.curves import CPU_FAMILIES, CURVED, MEMORY_FAMILIES, Shape

Floats = NDArray[np.float64]

GRID = 36
ROUNDS = 9
NARROW = 7
_LEVELS = {"constant": 1, "hyperbolic_linear": 3, "power": 3, "exponential": 3}


@dataclass(frozen=True, slots=True)
class Fit:
    """One pair of families fitted to n samples.

    `loo` holds, for each sample, the relative error (predicted - measured) / |measured| of the fit without
    it, NaN where that fit does not exist.
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
        """Whether there are two more samples than parameters and each of them could be left out."""
        return self.n >= self.p + 2 and all(np.isfinite(self.loo))

    @property
    def loo_mean(self) -> float:
        """Mean absolute leave-one-out error, relative; NaN where a fold has no fit."""
        return float(np.mean(np.abs(self.loo)))

    @property
    def loo_median(self) -> float:
        """Median absolute leave-one-out error, relative."""
        return float(np.median(np.abs(self.loo)))

    @property
    def loo_max(self) -> float:
        """Worst absolute leave-one-out error, relative."""
        return float(np.max(np.abs(self.loo)))

    def predict(self, vcpus: ArrayLike, memory_gib: ArrayLike) -> Floats:
        """The curve's value at each machine."""
        return curves.predict(self.shape, self.coefficients, vcpus, memory_gib)


def fit_all(vcpus: ArrayLike, memory_gib: ArrayLike, latency_s: ArrayLike) -> tuple[Fit, ...]:
    """Every pair of families that n samples can determine (p < n, enough distinct vCPUs and GiB; always the
    constant), in the order of `CPU_FAMILIES` and then `MEMORY_FAMILIES`.

    All three have length n >= 1. Raises ValueError for unequal lengths, no sample, a value that is not
    finite, or vCPUs or memory that are not positive.
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
        _fit(Shape(cpu, memory), c, m, y, keep, levels)
        for cpu, memory in itertools.product(CPU_FAMILIES, MEMORY_FAMILIES)
    )
    return tuple(fit for fit in fits if fit is not None)


def _fit(
    shape: Shape, c: Floats, m: Floats, y: Floats, keep: NDArray[np.bool_], levels: NDArray[np.intp]
) -> Fit | None:
    """One fit of the whole (first row of `keep`) and of every fold; None where the whole determines none."""
    needed = (_LEVELS.get(shape.cpu, 2), _LEVELS.get(shape.memory, 2))
    determined = np.asarray((levels >= np.array(needed)).all(axis=1))
    if not determined[0] or (shape.parameters > 1 and shape.parameters >= len(y)):
        return None
    exponents = _exponents(shape, c, m, y, keep)
    linear, full_rank = _solve(_designs(shape, c, m, exponents), y, keep)
    if not full_rank[0]:
        return None
    coefficients = _polish(shape, np.concatenate([linear[0], exponents[0]]), c, m, y)
    fitted = curves.predict(shape, coefficients, c, m)
    residuals = y - fitted
    total = float(np.sum((y - y.mean()) ** 2))
    r2 = 1 - float(np.sum(residuals**2)) / total if total > 0 else float("nan")
    loo = _leave_one_out(shape, c, m, y, np.column_stack([linear, exponents])[1:])
    loo[~(determined & full_rank)[1:]] = np.nan
    return Fit(shape=shape, coefficients=tuple(coefficients.tolist()), n=len(y), r2=r2, loo=tuple(loo.tolist()))


def _leave_one_out(shape: Shape, c: Floats, m: Floats, y: Floats, folds: Floats) -> Floats:
    """Relative error of each sample under the fit without it; `folds` is n x p."""
    predicted = [curves.predict(shape, row, c[i], m[i]) for i, row in enumerate(folds)]
    return (np.array(predicted, float) - y) / np.where(y == 0, 1.0, np.abs(y))


def _designs(shape: Shape, c: Floats, m: Floats, exponents: Floats) -> Floats:
    """Linear columns of every fold, folds x n x q."""
    if not any(shape.curved):
        one = curves.columns(shape, c, m, ())
        return np.broadcast_to(one, (len(exponents), *one.shape))
    return np.stack([curves.columns(shape, c, m, row) for row in exponents])


def _solve(designs: Floats, y: Floats, keep: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
    """Least squares of every fold at once: coefficients (folds x q), and whether each fold has full rank."""
    masked = designs * keep[:, :, None]
    scale = np.linalg.norm(masked, axis=1, keepdims=True)
    scale[scale == 0] = 1.0
    u, s, vt = np.linalg.svd(masked / scale, full_matrices=False)
    full_rank = (s[:, -1] > 1e-10 * s[:, 0]) if s.shape[1] == designs.shape[2] else np.zeros(len(s), bool)
    inverse = np.where(s > 1e-12 * s[:, :1], 1 / np.maximum(s, 1e-300), 0.0)
    projected = np.einsum("fnq,fn->fq", u, keep * y) * inverse
    return np.einsum("fqp,fq->fp", vt, projected) / scale[:, 0, :], full_rank


def _exponents(shape: Shape, c: Floats, m: Floats, y: Floats, keep: NDArray[np.bool_]) -> Floats:
    """The exponents of every fold (folds x 0, 1 or 2) that leave the smallest sum of squares."""
    curved = [(family, x) for family, x in ((shape.cpu, c), (shape.memory, m)) if family in CURVED]
    if not curved:
        return np.empty((len(keep), 0))
    flat = Shape(*("constant" if family in CURVED else family for family in (shape.cpu, shape.memory)))
    basis = np.linalg.qr(curves.columns(flat, c, m, ()) * keep[:, :, None]).Q
    target = _residual(np.broadcast_to(y, keep.shape)[:, None, :] * keep[:, None, :], basis)[:, 0]
    grids = [np.tile(curves.exponent_grid(family, x, GRID), (len(keep), 1)) for family, x in curved]
    best = np.empty((len(keep), len(curved)))
    for _ in range(ROUNDS):
        tried = [
            _residual(_column(family, x, grid) * keep[:, None, :], basis)
            for (family, x), grid in zip(curved, grids, strict=True)
        ]
        at = _largest_gain(tried, target)
        grids = [_narrower(grid, at[:, axis]) for axis, grid in enumerate(grids)]
        best = np.stack([grid[:, NARROW // 2] for grid in grids], axis=1)
    return best


def _column(family: str, x: Floats, grid: Floats) -> Floats:
    """The family's column for each exponent, folds x exponents x n, of the order of one."""
    middle = np.exp(np.mean(np.log(x))) if family == "power" else np.max(x)
    inner = np.log(x / middle) if family == "power" else x - middle
    exponent = grid[:, :, None] * inner
    column: Floats = np.exp(exponent - np.max(exponent, axis=2, keepdims=True))
    return column


def _residual(values: Floats, basis: Floats) -> Floats:
    """What is left of folds x k x n after projecting out each fold's basis (folds x n x q)."""
    left: Floats = values - (values @ basis) @ np.swapaxes(basis, 1, 2)
    return left


def _largest_gain(tried: Sequence[Floats], target: Floats) -> NDArray[np.intp]:
    """Index of the exponents that explain most of the target, folds x number of exponents."""
    first = tried[0]
    a = np.sum(first * first, axis=2)
    u = np.einsum("fkn,fn->fk", first, target)
    with np.errstate(divide="ignore", invalid="ignore"):
        if len(tried) == 1:
            gain = np.where(a > 1e-20, u**2 / a, -1.0)
            return np.asarray(np.argmax(gain, axis=1)[:, None])
        second = tried[1]
        b = np.sum(second * second, axis=2)
        v = np.einsum("fkn,fn->fk", second, target)
        cross = first @ np.swapaxes(second, 1, 2)
        determinant = a[:, :, None] * b[:, None, :] - cross**2
        gain = (
            b[:, None, :] * u[:, :, None] ** 2
            - 2 * cross * u[:, :, None] * v[:, None, :]
            + a[:, :, None] * v[:, None, :] ** 2
        ) / determinant
        gain = np.where(determinant > 1e-9 * a[:, :, None] * b[:, None, :], gain, -1.0)
    flat = np.argmax(gain.reshape(len(gain), -1), axis=1)
    return np.stack(np.unravel_index(flat, gain.shape[1:]), axis=1)


def _narrower(grid: Floats, at: NDArray[np.intp]) -> Floats:
    """A finer grid of `NARROW` exponents between the neighbours of the best one, for each fold."""
    rows = np.arange(len(grid))
    middle = grid[rows, at]
    low = grid[rows, np.maximum(at - 1, 0)]
    high = grid[rows, np.minimum(at + 1, grid.shape[1] - 1)]
    half = NARROW // 2
    steps = np.arange(1, half + 1) / (half + 1)
    below = middle[:, None] - (middle - low)[:, None] * steps[::-1]
    above = middle[:, None] + (high - middle)[:, None] * steps
    return np.concatenate([below, middle[:, None], above], axis=1)


def _polish(shape: Shape, start: Floats, c: Floats, m: Floats, y: Floats) -> Floats:
    """Gauss-Newton steps from an already good start, kept only while they lower the sum of squares."""
    best, coefficients, trial = np.inf, start, start
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(8 if any(shape.curved) else 1):
            residuals = y - curves.predict(shape, trial, c, m)
            squares = float(residuals @ residuals)
            jacobian = curves.gradient(shape, trial, c, m)
            scale = np.linalg.norm(jacobian, axis=0)
            if not squares < best or not np.isfinite(scale).all() or (scale == 0).any():
                break
            best, coefficients = squares, trial
            trial = trial + np.linalg.lstsq(jacobian / scale, residuals, rcond=1e-12)[0] / scale
    return coefficients
