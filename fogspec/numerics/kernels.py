"""Machines as arrays, and kernel features: the covariance components of machines that behave alike.

A component is a feature matrix F (N, r), which contributes F F' to the covariance of log-latencies. Low rank keeps a
catalog of a thousand machines cheap, and a joint draw is F z with z ~ N(0, I).
"""

from dataclasses import dataclass
from typing import TypeVar
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Scalar = TypeVar("Scalar", bound=np.generic)
MOST_NUMBERS = 20_000_000  # in a table of machines by kinds: far beyond any cloud's catalog
DIGITS = 9  # significant ones of a number that leaves the model
_POWERS = np.array([float(f"1e{power}") for power in range(-300, 301)])  # of ten, exactly rounded


@dataclass(frozen=True, slots=True, kw_only=True)
class Machines:
    """N machines as columns.

    Codes are those of `codes`, -1 if unknown (`gpu`: -1 = none); unknown numbers are NaN. Raise ValueError if lengths differ
    or a vCPU count or memory is not positive, or a price negative.
    """

    vcpus: Floats
    memory_gib: Floats
    price_usd_per_hour: Floats
    family: Ints
    arch: Ints
    cloud: Ints
    cpu_model: Ints
    gpu: Ints
    gpu_count: Floats
    gpu_memory_gib: Floats
    physical_cores: Floats
    clock_ghz: Floats
    burstable: NDArray[np.bool_]

    def __post_init__(self) -> None:
        n = len(self.vcpus)
        for name in self.__slots__:
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries, vcpus has {n}")
        for name in ("vcpus", "memory_gib"):
            column = getattr(self, name)
            if not bool(np.all(np.isfinite(column) & (column > 0))):
                raise ValueError(f"{name} must be positive and finite for every machine")
        if not bool(np.all(np.isfinite(self.price_usd_per_hour) & (self.price_usd_per_hour >= 0))):
            raise ValueError("price_usd_per_hour must be finite and not negative for every machine")

    def __len__(self) -> int:
        return len(self.vcpus)

    def take(self, rows: NDArray[np.intp]) -> "Machines":
        """Return the machines at these indices."""
        return Machines(**{name: getattr(self, name)[rows] for name in self.__slots__})

    @property
    def cores(self) -> Floats:
        """Physical cores; if unknown, vCPUs over the median vCPUs per core of the machines with known cores."""
        known = np.isfinite(self.physical_cores) & (self.physical_cores > 0)
        ratio = median(self.vcpus[known] / self.physical_cores[known]) if known.any() else 1.0
        return np.where(known, self.physical_cores, self.vcpus / ratio)


def distinct(values: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return the distinct values in their order, without the numpy.ma that np.unique alone imports."""
    return np.asarray(np.unique(values, return_counts=True)[0])


def median(values: Floats) -> float:
    """Return the median without np.median, whose first call imports numpy.ma."""
    ordered = np.sort(values)
    return float((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)


def quantised(values: Floats) -> Floats:
    """Return values (...) that leave a model to nine significant digits: others depend on processor and libraries."""
    with np.errstate(divide="ignore"):
        power = DIGITS - 1 - np.floor(np.log10(np.abs(values)))
    scale = _POWERS[300 + np.where(np.isfinite(power), power, 0.0).clip(-300, 300).astype(int)]
    return np.asarray(np.rint(values * scale) / scale)


def codes(names: list[str]) -> Ints:
    """Return integer codes of names, equal in every table (CRC-32 of the lower-case name); -1 for an empty name."""
    known = {name: crc32(name.lower().encode()) if name else -1 for name in set(names)}
    return np.fromiter(map(known.__getitem__, names), np.int64, len(names))


def one_hot(code: Ints) -> Floats:
    """Return one column per value, (N, values): machines of one code share a term, machines of unknown code have none.

    If the table would exceed `MOST_NUMBERS`, keep the most frequent values.
    """
    values, column, count = np.unique(code, return_inverse=True, return_counts=True)
    kept = np.flatnonzero(values >= 0)
    if len(kept) * len(code) > MOST_NUMBERS:
        kept = np.sort(kept[np.argsort(-count[kept], kind="stable")[: MOST_NUMBERS // len(code)]])
    matrix = np.zeros((len(code), len(kept)))
    at = np.full(len(values), -1)
    at[kept] = np.arange(len(kept))
    rows = np.flatnonzero(at[column] >= 0)
    matrix[rows, at[column[rows]]] = 1.0
    return matrix


def matern(columns: Floats, lengths: Floats) -> Floats:
    """Return a square root (N, distinct rows) of the Matérn-5/2 covariance of the rows of `columns` (N, d).

    `lengths` (d,) are the length scales.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, eq. 4.17.
    """
    points, where = _distinct(np.round(columns / lengths, 6))
    distance = np.sqrt(5.0) * np.sqrt(((points[:, None, :] - points[None, :, :]) ** 2).sum(-1))
    covariance = (1 + distance + distance**2 / 3) * np.exp(-distance)
    root = np.linalg.cholesky(covariance + 1e-8 * np.eye(len(points)))
    return np.asarray(root[where])


def _distinct(rows: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return the distinct rows of a matrix in lexicographic order, and the position of each row among them.

    As `np.unique` over axis 0, which compares rows field by field and takes six times as long.
    """
    first, where = np.zeros(min(len(rows), 1), dtype=np.intp), np.zeros(len(rows), dtype=np.intp)
    for column in rows.T:
        values, rank = np.unique(column, return_inverse=True)
        _, first, where = np.unique(where * len(values) + rank.ravel(), return_index=True, return_inverse=True)
    return rows[first], where.ravel()


def standardise(column: Floats) -> Floats:
    """Return a column of mean 0 and standard deviation 1; unknown entries become 0, a constant column all 0."""
    known = np.isfinite(column)
    if not known.any():
        return np.zeros(len(column))
    deviation = float(column[known].std())
    centred = np.where(known, column, column[known].mean()) - column[known].mean()
    return centred / deviation if deviation > 1e-9 else np.zeros(len(column))


def interaction(matrix: Floats, column: Floats) -> Floats:
    """Return each column of `matrix` (N, r) times `column` (N,)."""
    return matrix * column[:, None]


def hstack(*parts: Floats) -> Floats:
    """Return the feature matrices side by side: the sum of their covariances."""
    return np.concatenate([part if part.ndim == 2 else part[:, None] for part in parts], axis=1)
