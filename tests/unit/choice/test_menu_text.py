"""The sentences of the menu: what a limit that no machine meets is off by."""

import pytest

from fogspec.choice.menu import Limit, shown_miss, shown_probability

FREE = "$0.241 per 1,000 requests, more than nothing"


@pytest.mark.parametrize(
    ("limit", "bound", "needs", "factor", "shown"),
    [
        ("latency", "10ms", "1.648s", 164.8, ("10 ms", "1.65 s, 165 times the limit")),
        ("latency", "2s", "2.0004s", 1.0002, ("2 s", "2.0004 s, < 0.1% over the limit")),
        ("cost", "$0/request", "$0.000241/request", float("inf"), ("$0 per 1,000 requests", FREE)),
        ("metrics.drift", "0.04 m", "0.05 m", 1.25, ("0.04 m", "0.05 m, 1.25 times the limit")),
    ],
)
def test_a_missed_limit_says_by_how_much(
    limit: str, bound: str, needs: str, factor: float, shown: tuple[str, str]
) -> None:
    miss = Limit(
        limit=limit,
        bound=bound,
        nearest_value=needs,
        factor=factor,
        infra="aws/us-east-1",
        instance="c6i.large",
        alone=True,
    )
    assert shown_miss(miss) == shown


def test_a_small_probability_is_not_zero() -> None:
    assert [shown_probability(one) for one in (0.0, 0.001, 0.324)] == ["less than 0.01", "less than 0.01", "0.32"]
