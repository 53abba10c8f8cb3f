"""The grid of edge cases: levels, snapping, skipping, and the preferred machine of a cell."""

import numpy as np
import pytest

from fogspec.numerics.design import edge_grid, upper_median


def grid(machines: list[tuple[float, float]], order: list[int] | None = None):
    vcpus, memory_gib = (np.array(column, dtype=np.float64) for column in zip(*machines, strict=True))
    return edge_grid(vcpus, memory_gib, np.array(order if order is not None else range(len(machines)), dtype=np.intp))


@pytest.mark.parametrize(
    ("values", "median"), [([2, 4, 8, 16, 32, 64], 16), ([4, 8, 16], 8), ([2, 4], 4), ([8], 8), ([2, 2, 2, 64], 64)]
)
def test_the_average_is_the_upper_median_of_the_distinct_values(values: list[float], median: float) -> None:
    assert upper_median(np.array(values, dtype=np.float64)) == median


def test_the_median_of_nothing_is_an_error() -> None:
    with pytest.raises(ValueError, match="median of nothing"):
        upper_median(np.array([]))


def test_table_one_of_the_paper() -> None:
    machines = [(c, c * ratio) for c in (2, 4, 8, 16, 32, 48, 64) for ratio in (2, 4, 8)]
    found = grid([(float(c), float(m)) for c, m in machines if c != 48])
    assert [(cell.vcpus, cell.memory_gib) for cell in found.cells] == [
        (2, 4), (2, 8), (2, 16), (16, 32), (16, 64), (16, 128), (64, 128), (64, 256), (64, 512),
    ]  # fmt: skip
    assert found.skipped == ()
    assert not any(cell.snapped or cell.same_as is not None for cell in found.cells)


def test_a_median_between_two_sizes_snaps_to_the_larger_and_repeats_are_marked() -> None:
    found = grid([(4, 8), (4, 16)])
    assert [(cell.asked_gib, cell.memory_gib, cell.same_as) for cell in found.cells] == [
        (8, 8, None), (12, 16, None), (16, 16, 1),
    ]  # fmt: skip
    assert found.cells[1].snapped
    assert found.skipped == ("median", "largest")


def test_two_vcpu_levels_skip_the_median() -> None:
    found = grid([(2, 4), (8, 16)])
    assert [cell.levels for cell in found.cells if cell.same_as is None] == [
        ("smallest", "smallest"), ("largest", "smallest"),
    ]  # fmt: skip
    assert found.skipped == ("median",)


def test_a_cell_takes_its_most_preferred_machine() -> None:
    assert grid([(2, 4), (2, 4), (2, 4)], order=[2, 0, 1]).cells[0].row == 2
