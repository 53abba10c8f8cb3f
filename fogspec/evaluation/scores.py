"""Scores of a run against the truth, and their summary over problems of a kind."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fogspec.evaluation.replay import Run
from fogspec.numerics.acquisition import Objective
from fogspec.numerics.features import Floats

TOLERANCE = 0.05  # a limit broken by less is not counted as broken
BINS = np.array([0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0])  # of stated probabilities


@dataclass(frozen=True, slots=True)
class Score:
    """One problem and setting. `regret` is relative to the best feasible machine, NaN for none or an infeasible choice."""

    kind: str
    ok: tuple[bool, bool, bool]
    bench: float
    samples: int
    violation5: bool
    false_infeasible: bool
    regret: float
    mdape: float
    covered: int
    predicted: int
    hypervolume: float
    stated: Floats


def score(kind: str, run: Run, truth_s: Floats, price: Floats, objective: Objective) -> Score:
    """Compare a run with the true latencies."""
    value = objective.value(truth_s)
    feasible = truth_s <= objective.limit_s
    exists = bool(feasible.any())
    best = float(value[feasible].min()) if exists else np.nan
    ok, violated, regret = (False, False, False), False, np.nan
    if run.chosen is None:
        ok = (not exists,) * 3
    else:
        violated = bool(truth_s[run.chosen] > objective.limit_s[run.chosen] * (1 + TOLERANCE))
        if exists and not violated:
            regret = float(value[run.chosen] / best - 1)
            ok = (regret <= 0.01, regret <= 0.05, regret <= 0.10)
    unseen = np.ones(len(truth_s), dtype=bool)
    unseen[list(run.sampled)] = False
    log = np.log(truth_s)
    with_interval = unseen & np.isfinite(run.low)
    inside = (run.low <= log) & (log <= run.high)
    error = np.abs(np.exp(run.log_latency[unseen]) / truth_s[unseen] - 1)
    return Score(
        kind, ok, run.paid / float(price.sum()), len(run.sampled), violated, exists and run.chosen is None, regret,
        float(np.nanmedian(error)) if np.isfinite(error).any() else np.nan,
        int((inside & with_interval).sum()), int(with_interval.sum()),
        _hypervolume_ratio(run, truth_s, price), _stated(run, truth_s, objective),
    )  # fmt: skip


def _stated(run: Run, truth_s: Floats, objective: Objective) -> Floats:
    """Stated probabilities to meet the limits, by bin: sums of p and of met, and machines (bins, 3)."""
    limited = np.isfinite(objective.limit_s) & np.isfinite(run.probability_met)
    stated, met = run.probability_met[limited], (truth_s <= objective.limit_s)[limited]
    which = np.clip(np.searchsorted(BINS, stated, side="right") - 1, 0, len(BINS) - 2)
    return np.column_stack([np.bincount(which, weights, len(BINS) - 1) for weights in (stated, met, np.ones(len(met)))])


def front(latency_s: Floats, price: Floats) -> np.ndarray:
    """Indices of machines that no other beats in both latency and price per hour, by price."""
    order = np.lexsort((latency_s, price))
    best = np.minimum.accumulate(latency_s[order])
    keep = np.append(True, latency_s[order][1:] < best[:-1])
    return np.asarray(order[keep])


def _hypervolume(latency_s: Floats, price: Floats, corner: tuple[float, float]) -> float:
    inside = (latency_s < corner[0]) & (price < corner[1])
    if not inside.any():
        return 0.0
    latency_s, price = latency_s[inside], price[inside]
    rows = front(latency_s, price)
    heights = np.append(price[rows][1:], corner[1]) - price[rows]
    return float(((corner[0] - latency_s[rows]) * heights).sum())


def _hypervolume_ratio(run: Run, truth_s: Floats, price: Floats) -> float:
    """True hypervolume of the machines predicted to be on the front, over that of the true front (log scales)."""
    if not np.isfinite(run.log_latency).any():
        return float("nan")
    log_truth, log_price = np.log(truth_s), np.log(price)
    corner = (float(log_truth.max()) + 0.1, float(log_price.max()) + 0.1)
    predicted = front(np.where(np.isfinite(run.log_latency), run.log_latency, np.inf), log_price)
    whole = _hypervolume(log_truth, log_price, corner)
    return _hypervolume(log_truth[predicted], log_price[predicted], corner) / whole


def summary(kind: str, problems: int, scores: Sequence[Score]) -> dict[str, Any]:
    """The row of one kind of problem; shares are fractions, not per cent."""
    regret = np.array([s.regret for s in scores])
    regret = regret[np.isfinite(regret)]
    predicted = sum(s.predicted for s in scores)
    return {
        "kind": kind,
        "problems": problems,
        **{name: float(np.mean([s.ok[i] for s in scores])) for i, name in enumerate(("ok1", "ok5", "ok10"))},
        "bench": float(np.mean([s.bench for s in scores])),
        "samples": float(np.mean([s.samples for s in scores])),
        "violation5": float(np.mean([s.violation5 for s in scores])),
        "false_infeasible": float(np.mean([s.false_infeasible for s in scores])),
        "regret": {
            "median": float(np.median(regret)) if len(regret) else None,
            "p90": float(np.quantile(regret, 0.9)) if len(regret) else None,
            "p99": float(np.quantile(regret, 0.99)) if len(regret) else None,
        },
        "mdape": _mean([s.mdape for s in scores]),
        "coverage90": sum(s.covered for s in scores) / predicted if predicted else None,
        "hypervolume": _mean([s.hypervolume for s in scores]),
    }


def calibration(scores: Sequence[Score]) -> list[dict[str, float]]:
    """Of the machines said to meet the limits with probability about p, how many do: rows of {p, met, machines}."""
    total = np.sum([s.stated for s in scores], axis=0)
    return [{"p": p / n, "met": met / n, "machines": int(n)} for p, met, n in total.tolist() if n]


def _mean(values: list[float]) -> float | None:
    finite = [v for v in values if np.isfinite(v)]
    return float(np.mean(finite)) if finite else None
