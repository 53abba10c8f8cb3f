"""The Pareto front against its definition."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fogspec.numerics.pareto import pareto

points = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=40)


@given(points)
def test_it_is_what_the_definition_says(pairs):
    x, y = (np.array([p[i] for p in pairs], float) for i in (0, 1))
    found = pareto(x, y)
    on_front = {p for p in pairs if not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in pairs)}
    assert {pairs[i] for i in found} == on_front
    assert len(found) == len(on_front)
    assert list(found) == [pairs.index(pairs[i]) for i in found]
    assert list(x[found]) == sorted(x[found])
