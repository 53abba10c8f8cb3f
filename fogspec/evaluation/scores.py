"""Scores of a run against the truth, and their summary over problems of a kind."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fogspec.choice.rule import Rule
from fogspec.evaluation.replay import Run
from fogspec.evaluation.suites import Problem
from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.servers import shifts_of

TOLERANCE = 0.05  # a limit violated by less counts as met; the choice itself has no tolerance
BINS = np.array([0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0])  # of stated probabilities


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One problem and setting. `regret` is relative to the best feasible machine, NaN for none or an infeasible choice.

    `covered` of the `predicted` machines are expected in their 90% range when another server of the type is measured.
    """

    kind: str
    ok: tuple[bool, bool, bool]
    bench: float
    samples: int
    violation5: bool
    false_infeasible: bool
    regret: float
    mdape: float
    covered: float
    predicted: int
    hypervolume: float
    stated: Floats

    def as_dict(self) -> dict[str, Any]:
        """Return the scores of one run; None where a score is not defined."""
        known = {"regret": self.regret, "mdape": self.mdape, "hypervolume": self.hypervolume}
        return {
            "bench": self.bench,
            "ok1": self.ok[0],
            "ok5": self.ok[1],
            "ok10": self.ok[2],
            "violation5": self.violation5,
            "false_infeasible": self.false_infeasible,
            **{name: float(value) if np.isfinite(value) else None for name, value in known.items()},
            "coverage90": self.covered / self.predicted if self.predicted else None,
        }


def score(problem: Problem, rule: Rule, machines: Machines, run: Run) -> Score:
    """Compare a run with the true latencies; a limit that is violated by less than `TOLERANCE` counts as met."""
    truth_s, truth, price = problem.latency_s, problem.truth(rule), machines.price_usd_per_hour
    exists = truth.best is not None
    ok, violated, regret = (False, False, False), False, np.nan
    if run.chosen is None:
        ok = (not exists,) * 3
    else:
        violated = bool(truth_s[run.chosen] > truth.latency_budget_s[run.chosen] * (1 + TOLERANCE)) or any(
            problem.metrics[name][run.chosen] > bound * (1 + TOLERANCE) for name, bound in rule.max_metrics.items()
        )
        if truth.best is not None and not violated:
            regret = float(truth.objective[run.chosen] / truth.objective[truth.best] - 1)
            ok = (regret <= 0.01, regret <= 0.05, regret <= 0.10)
    unseen = np.ones(len(truth_s), dtype=bool)
    unseen[list(run.sampled)] = False
    log = np.log(truth_s)
    with_interval = unseen & np.isfinite(run.low)
    inside = shifts_of(machines.cloud).between(run.low - log, run.high - log)
    error = np.abs(np.exp(run.log_latency[unseen]) / truth_s[unseen] - 1)
    return Score(
        kind=problem.kind,
        ok=ok,
        bench=run.paid / float(price.sum()),
        samples=len(run.sampled),
        violation5=violated,
        false_infeasible=exists and run.chosen is None,
        regret=regret,
        mdape=float(np.nanmedian(error)) if np.isfinite(error).any() else np.nan,
        covered=float(inside[with_interval].sum()),
        predicted=int(with_interval.sum()),
        hypervolume=_hypervolume_ratio(run, truth_s, price),
        stated=_stated(run, truth_s, truth.latency_budget_s),
    )


def _stated(run: Run, truth_s: Floats, budget_s: Floats) -> Floats:
    """Return the stated probabilities to meet the limits by bin: sums of p and of met, and machines (bins, 3)."""
    limited = np.isfinite(budget_s) & np.isfinite(run.probability_met)
    stated, met = run.probability_met[limited], (truth_s <= budget_s)[limited]
    which = np.clip(np.searchsorted(BINS, stated, side="right") - 1, 0, len(BINS) - 2)
    return np.column_stack([np.bincount(which, weights, len(BINS) - 1) for weights in (stated, met, np.ones(len(met)))])


def front(latency_s: Floats, price: Floats) -> np.ndarray:
    """Return the indices of machines that no other beats in both latency and price per hour, by price."""
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
    """Return the true hypervolume of the machines predicted to be on the front, over that of the true front (log scales)."""
    if not np.isfinite(run.log_latency).any():
        return float("nan")
    log_truth, log_price = np.log(truth_s), np.log(price)
    corner = (float(log_truth.max()) + 0.1, float(log_price.max()) + 0.1)
    predicted = front(np.where(np.isfinite(run.log_latency), run.log_latency, np.inf), log_price)
    whole = _hypervolume(log_truth, log_price, corner)
    return _hypervolume(log_truth[predicted], log_price[predicted], corner) / whole


def r2(predicted: Floats, truth: Floats) -> float | None:
    """Return the coefficient of determination over every machine with a prediction."""
    known = np.isfinite(predicted)
    total = ((truth[known] - truth[known].mean()) ** 2).sum() if known.any() else 0.0
    if not total > 0:
        return None
    return float(1 - ((predicted[known] - truth[known]) ** 2).sum() / total)


def median_error(predicted: Floats, truth: Floats, sampled: Sequence[int]) -> float | None:
    """Return the median relative error over the machines that were not sampled; None without a prediction of one."""
    unseen = np.ones(len(truth), dtype=bool)
    unseen[list(sampled)] = False
    error = np.abs(predicted[unseen] / truth[unseen] - 1)
    return float(np.nanmedian(error)) if np.isfinite(error).any() else None


def staircase_deviation(predicted_s: Floats, truth_s: Floats, price: Floats) -> float | None:
    """Return by how much the machine that is predicted fastest within an hourly budget is slower, over all budgets at most."""
    order = np.lexsort((truth_s, price))
    predicted = np.where(np.isfinite(predicted_s), predicted_s, np.inf)[order]
    if not np.isfinite(predicted).any():
        return None
    first = int(np.flatnonzero(np.isfinite(predicted))[0])
    truth = truth_s[order]
    fastest = np.minimum.accumulate(truth)
    leader = np.array([int(predicted[: i + 1].argmin()) for i in range(len(order))])
    return float((truth[leader] / fastest - 1)[first:].max())


def summary(kind: str, problems: int, scores: Sequence[Score]) -> dict[str, Any]:
    """Return the row of one kind of problem; shares are fractions, not per cent."""
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
    """Return rows of {p, met, machines}: the share that meets the limits, of the machines stated to do so with about p."""
    total = np.sum([s.stated for s in scores], axis=0)
    return [{"p": p / n, "met": met / n, "machines": int(n)} for p, met, n in total.tolist() if n]


def _mean(values: list[float]) -> float | None:
    finite = [v for v in values if np.isfinite(v)]
    return float(np.mean(finite)) if finite else None
