"""Sampling designs: the machines to measure, as row numbers of n machines."""

import statistics
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Level = Literal["smallest", "median", "largest"]
LEVELS: tuple[Level, ...] = ("smallest", "median", "largest")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One cell of the grid: its vCPUs, the requested memory and the memory of the nearest row, in GiB.

    `row` is the most preferred row there; `levels` name the row and column of the grid, and `same_as` is the position in
    the grid of an earlier cell with the same row, None for a cell that adds a machine.
    """

    vcpus: float
    asked_gib: float
    memory_gib: float
    levels: tuple[Level, Level]
    row: int
    same_as: int | None

    @property
    def snapped(self) -> bool:
        """Flag: no machine has the requested memory."""
        return self.memory_gib != self.asked_gib


@dataclass(frozen=True, slots=True)
class Grid:
    """The cells of a grid, row by row, and the vCPU levels skipped because they equal another level."""

    cells: tuple[Cell, ...]
    skipped: tuple[Level, ...]


def upper_median(values: Floats) -> float:
    """Return the upper median of the distinct values: 16 of 2, 4, 8, 16, 32, 64. Raise ValueError for no values."""
    distinct = sorted(set(values.tolist()))
    if not distinct:
        raise ValueError("the median of nothing")
    return float(distinct[len(distinct) // 2])


def edge_grid(vcpus: Floats, memory_gib: Floats, order: NDArray[np.intp]) -> Grid:
    """Return the edge cases of a set of machines (FogROS2-Config, section 2.A and Table I) as defined in ADR 0007.

    `vcpus` and `memory_gib` have shape (n,), n > 0; `order` lists the n rows from the most to the least preferred. vCPU
    levels are the smallest, the upper median and the largest of the distinct counts; for each, memory levels are the
    smallest, the median and the largest distinct size available there. A median between two sizes snaps to the larger, as
    both are equally near. Every cell takes its most preferred row.
    """
    cells: list[Cell] = []
    place = np.empty(len(order), dtype=np.intp)
    place[order] = np.arange(len(order))
    levels = _levels(vcpus, upper_median(vcpus))
    for cpu_level, cpus in levels.items():
        here = np.flatnonzero(vcpus == cpus)
        sizes = memory_gib[here]
        median = statistics.median(set(sizes.tolist()))
        for memory_level, asked in zip(LEVELS, (float(sizes.min()), median, float(sizes.max())), strict=True):
            near = _nearest(sizes, asked)
            rows = here[sizes == near]
            taken = rows[place[rows].argmin()]
            same = next((i for i, cell in enumerate(cells) if cell.row == taken), None)
            cells.append(
                Cell(
                    vcpus=cpus,
                    asked_gib=asked,
                    memory_gib=near,
                    levels=(cpu_level, memory_level),
                    row=int(taken),
                    same_as=same,
                )
            )
    skipped = tuple(level for level in LEVELS if level not in levels)
    return Grid(tuple(cells), skipped)


def _levels(values: Floats, median: float) -> dict[Level, float]:
    """Return the distinct levels; the outer levels take precedence over the median."""
    low, high = float(values.min()), float(values.max())
    found: dict[Level, float] = {"smallest": low}
    if low < median < high:
        found["median"] = median
    if high > low:
        found["largest"] = high
    return found


def _nearest(sizes: Floats, asked: float) -> float:
    distance = np.abs(sizes - asked)
    return float(sizes[distance == distance.min()].max())
