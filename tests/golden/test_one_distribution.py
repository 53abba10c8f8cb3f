"""Range and probability of every machine are of one distribution: as printed, and as `models.yaml` has it."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from fogspec.base import units
from fogspec.choice.rule import MOST_CERTAIN, Rule, Selection
from fogspec.model.predict import Predictions
from fogspec.numerics.observations import observations
from fogspec.numerics.prediction import Prediction
from fogspec.numerics.surrogate import prepare
from tests.support.machines import family, rule_over
from tests.support.menus import with_role

COMPILED = Path(__file__).resolve().parents[2] / "compiled"
NAMES = sorted(path.parent.name for path in COMPILED.glob("*/manifest.yaml"))
DIGITS = 6e-4  # of what is printed with four digits


def below(one: Sequence[float], shift: dict[str, float], value: float) -> float:
    """P(value of another server <= value), from the numbers in the file alone."""
    mu, sigma = one
    z, wide = math.log(value) - mu, math.hypot(sigma, shift["spread"])
    return (1 - shift["tail"]) * float(ndtr(z / sigma)) + shift["tail"] * float(ndtr(z / wide))


@pytest.mark.parametrize("name", NAMES)
def test_what_is_committed_follows_from_the_distribution_in_models(name: str) -> None:
    models, menu, manifest = (
        yaml.safe_load((COMPILED / name / f"{kind}.yaml").read_text()) for kind in ("models", "menu", "manifest")
    )
    predicted, shifts, limits = models["spec"]["predictions"], models["spec"]["shift"], menu["spec"]["limits"]
    assert {one.split("/")[0] for one in shifts} == {"local" if name == "cubicles-planner" else "aws"}
    seen = 0
    for entry in (*menu["spec"]["front"], *menu["spec"].get("others", ())):
        cloud = entry["infra"].split("/")[0]
        gpu = entry.get("gpu")
        machine = f"{cloud}/{entry['instance']}" + (f" {gpu['name']}:{gpu['count']}" if gpu else "")
        one = predicted["latency"]["machines"][machine]
        latency_s, low_s, high_s = map(units.parse_duration_s, (entry["latency"], *entry["interval"]))
        assert latency_s == pytest.approx(math.exp(one[0]), rel=DIGITS)
        assert below(one, shifts[cloud], low_s) == pytest.approx(0.05, abs=2e-3)
        assert below(one, shifts[cloud], high_s) == pytest.approx(0.95, abs=2e-3)
        budget_s = units.parse_duration_s(limits["latency"])
        if "cost" in limits:
            assert menu["spec"]["billing"] == "busy"
            usd_per_s = units.parse_price_usd_per_hour(entry["price"]) / 3600
            budget_s = min(budget_s, units.parse_cost_usd_per_request(limits["cost"]) / usd_per_s)
        met = below(one, shifts[cloud], budget_s)
        for metric, values in entry.get("metrics", {}).items():
            own = predicted[metric]["machines"][machine]
            if "limit" in values:
                met *= below(own, {"tail": 0.0, "spread": 0.0}, values["limit"])
        assert entry["probability"] == pytest.approx(min(met, MOST_CERTAIN), abs=1.1e-3)
        assert not entry.get("meets", True) or entry["probability"] >= 0.9
        seen += 1
    assert seen
    expected, chosen = manifest["expected"], with_role(menu["spec"], "balanced")
    assert chosen is not None
    assert expected["limits"]["probability_met"] == chosen["probability"]
    assert expected["latency"]["interval"] == chosen["interval"]
    assert chosen["probability"] >= expected["limits"]["confidence"]


MACHINES = family()
SPACE = prepare(MACHINES)
rows = st.lists(st.tuples(st.integers(0, len(MACHINES) - 1), st.floats(0.01, 100)), min_size=1, max_size=8)


@settings(max_examples=60)
@given(rows, st.floats(0.01, 100), st.floats(1e-6, 1e-2))
def test_what_is_generated_follows_from_one_distribution(
    samples: list[tuple[int, float]], latency_s: float, cost_usd: float
) -> None:
    at, measured_s = zip(*samples, strict=True)
    posterior = SPACE.fit(observations(list(at), list(measured_s)))
    rule: Rule = rule_over(MACHINES, alpha=0.5, max_latency_s=latency_s, max_cost_usd=cost_usd)
    found = Selection(rule=rule, latency=Predictions.of_posterior(posterior))
    for row in range(len(MACHINES)):
        ends = found.latency.interval(row, 0.9)
        assert ends is not None
        implied = fitted(ends, posterior.prediction, row)
        p = implied(float(found.latency_budget_s[row]))
        assert found.probability(row) == pytest.approx(min(p, MOST_CERTAIN), abs=1e-3)
        if ends[1] <= found.latency_budget_s[row]:
            assert (found.probability(row) or 0) >= 0.95 - 1e-6
        if found.feasible[row]:
            assert (found.probability(row) or 0) >= 0.9
    best = found.best
    assert best is None or found.feasible[best]


def fitted(ends: tuple[float, float], prediction: Prediction, row: int) -> Any:
    """Return the probability that a range implies: the mixture with the cloud's shift whose ends these are."""
    low, high = map(math.log, ends)
    tail, spread = float(prediction.tail[row]), float(prediction.spread[row])
    middle, smallest, largest = (low + high) / 2, 1e-9, (high - low) / 2
    for _ in range(80):
        sigma = (smallest + largest) / 2
        inside = below((middle, sigma), {"tail": tail, "spread": spread}, ends[1])
        smallest, largest = (sigma, largest) if inside > 0.95 else (smallest, sigma)
    shift = {"tail": tail, "spread": spread}

    def p(bound: float) -> float:
        if not np.isfinite(bound):
            return 1.0
        return below((middle, sigma), shift, bound) if bound > 0 else 0.0

    return p
