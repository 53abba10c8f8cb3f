"""The demo's limit: half of the shapes miss it where CPUs help, and there is none where they do not."""

import pytest

from tests.tools.demo import limit_between


@pytest.mark.parametrize(
    ("mean_s", "limit_s", "missed"),
    [
        ({1: 1.0, 2: 0.5}, 0.71, 1),
        ({1: 2.0, 2: 1.0, 4: 0.5, 8: 0.25}, 0.71, 2),
        ({1: 2.0, 2: 1.0, 4: 0.9, 8: 0.9}, 1.4, 1),
        ({1: 1.0, 2: 0.9}, None, 0),
        ({1: 1.0}, None, 0),
        ({}, None, 0),
    ],
)
def test_the_limit_lies_between_shapes_that_differ(
    mean_s: dict[int, float], limit_s: float | None, missed: int
) -> None:
    assert limit_between(mean_s) == limit_s
    assert sum(one > limit_s for one in mean_s.values() if limit_s is not None) == missed
