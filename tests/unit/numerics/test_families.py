"""Each family of the fits has a curve; a name without one is refused, and not fitted as another family."""

import numpy as np
import pytest

from fogspec.numerics.families import CPU_FAMILIES, MEMORY_FAMILIES, Shape, curve, predict


def test_each_family_has_a_curve_and_no_two_have_the_same() -> None:
    x = np.array([2.0, 16.0, 64.0])
    found = {name: tuple(np.concatenate([x[:0], *curve(name, x, 0.1)])) for name in {*CPU_FAMILIES, *MEMORY_FAMILIES}}
    assert len(set(found.values())) == len(found)


def test_a_family_without_a_curve_is_an_error() -> None:
    with pytest.raises(ValueError, match="cubic is not a curve family"):
        curve("cubic", np.array([2.0]), 0.1)
    with pytest.raises(ValueError, match="cubic is not a curve family"):
        predict(Shape("constant", "cubic"), [1.0], [2.0], [4.0])
