"""A mutated spec is still valid or has located mistakes; `python -m tests.damage.survey` does 100,000 of them."""

import pytest

from tests.damage.specs import mutants
from tests.damage.survey import report, survey


@pytest.mark.slow
def test_mutants_are_valid_or_located_and_the_fix_is_named() -> None:
    result = survey(300, seed=7)
    assert result.bad == []
    wrong = sum(result.total.values()) - sum(result.valid.values())
    assert sum(result.at_line.values()) / wrong >= 0.95, "\n".join(report(result))
    for kind in ("key renamed", "unit dropped"):
        assert result.right[kind] / result.with_right[kind] >= 0.8, "\n".join(report(result))


def test_mutants_are_the_same_for_the_same_seed_and_differ_from_the_original() -> None:
    text = "spec:\n  hardware:\n    cpus: 2..64\n    memory: 4GiB..8GiB\n  constraints:\n    latency: 2s\n"
    first, again, other = (list(mutants(text, 90, seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other
    assert all(one.content.decode() != text for one in first if one.kind not in ("character damaged", "value retyped"))
