"""Scores of a run against the truth, and their summary over problems of a kind."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fogspec.choice.rule import Rule
from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.prediction import Prediction
from fogspec.numerics.servers import shifts_of
from fogspec_lab.evaluation.replay import Run
from fogspec_lab.evaluation.suites import Problem

WITHIN = {"ok1": 0.01, "ok5": 0.05, "ok10": 0.10, "ok20": 0.20}  # the regret of a choice that is good enough, by score
TOLERANCE = 0.05  # a limit violated by less counts as met; the choice itself has no tolerance
BINS = np.array([0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0])  # of stated probabilities


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One problem, setting and seed. `regret` is relative to the best feasible machine, NaN for none or an infeasible choice.

    `ok` are the scores of `WITHIN`. `bench` is the cost of the samples over that of a whole sample of every machine, `usd` and
    `hours` their dollars and their time, batch after batch. `covered` of the `predicted` machines are expected in their 90%
    range when another server of the type is measured.
    """

    kind: str
    problem: str
    ok: tuple[bool, ...]
    bench: float
    usd: float
    hours: float
    samples: int
    violation5: bool
    false_infeasible: bool
    regret: float
    mdape: float | None
    covered: float
    predicted: int
    stated: Floats

    def as_dict(self) -> dict[str, Any]:
        """Return the scores of one run; None where a score is not defined."""
        return {
            "bench": self.bench,
            "usd": self.usd,
            "hours": self.hours,
            **dict(zip(WITHIN, self.ok, strict=True)),
            "violation5": self.violation5,
            "false_infeasible": self.false_infeasible,
            "regret": self.regret if np.isfinite(self.regret) else None,
            "mdape": self.mdape,
            "coverage90": self.covered / self.predicted if self.predicted else None,
        }


def score(problem: Problem, rule: Rule, machines: Machines, run: Run) -> Score:
    """Compare a run with the true latencies; a limit that is violated by less than `TOLERANCE` counts as met."""
    truth_s, truth, bill = problem.latency_s, problem.truth(rule, machines), run.bill
    exists = truth.best is not None
    ok, violated, regret = (False,) * len(WITHIN), False, np.nan
    if run.chosen is None:
        ok = (not exists,) * len(WITHIN)
    else:
        violated = bool(truth_s[run.chosen] > truth.latency_budget_s[run.chosen] * (1 + TOLERANCE)) or any(
            problem.metrics[name][run.chosen] > bound * (1 + TOLERANCE) for name, bound in rule.max_metrics.items()
        )
        if truth.best is not None and not violated:
            regret = float(truth.objective[run.chosen] / truth.objective[truth.best] - 1)
            ok = tuple(regret <= within for within in WITHIN.values())
    unseen = np.ones(len(truth_s), dtype=bool)
    unseen[list(bill.sampled)] = False
    log = np.log(truth_s)
    with_interval = unseen & np.isfinite(run.low)
    exact = Prediction(log, np.full(len(log), 1e-9), *shifts_of(machines.cloud))
    inside = exact.probability_below(np.exp(run.high)) - exact.probability_below(np.exp(run.low))
    return Score(
        kind=problem.kind,
        problem=problem.id,
        ok=ok,
        bench=bill.usd / bill.sweep_usd,
        usd=bill.usd,
        hours=bill.wall_s / 3600,
        samples=len(bill.sampled),
        violation5=violated,
        false_infeasible=exists and run.chosen is None,
        regret=regret,
        mdape=median_error(np.exp(run.log_latency), truth_s, bill.sampled),
        covered=float(inside[with_interval].sum()),
        predicted=int(with_interval.sum()),
        stated=_stated(run, truth_s, truth.latency_budget_s),
    )


def _stated(run: Run, truth_s: Floats, budget_s: Floats) -> Floats:
    """Return the stated probabilities to meet the limits by bin: sums of p and of met, and machines (bins, 3)."""
    limited = np.isfinite(budget_s) & np.isfinite(run.probability_met)
    stated, met = run.probability_met[limited], (truth_s <= budget_s)[limited]
    which = np.clip(np.searchsorted(BINS, stated, side="right") - 1, 0, len(BINS) - 2)
    return np.column_stack([np.bincount(which, weights, len(BINS) - 1) for weights in (stated, met, np.ones(len(met)))])


def median_error(predicted: Floats, truth: Floats, sampled: Sequence[int]) -> float | None:
    """Return the median relative error over the machines that were not sampled; None without a prediction of one."""
    unseen = np.ones(len(truth), dtype=bool)
    unseen[list(sampled)] = False
    error = np.abs(predicted[unseen] / truth[unseen] - 1)
    return float(np.nanmedian(error)) if np.isfinite(error).any() else None


def summary(kind: str, scores: Sequence[Score]) -> dict[str, Any]:
    """Return the row of one kind of problem; shares are fractions, `error` is standard errors over problems."""
    regret = np.array([s.regret for s in scores])
    regret = regret[np.isfinite(regret)]
    predicted, errors = sum(s.predicted for s in scores), [s.mdape for s in scores if s.mdape is not None]
    means = ("bench", "usd", "hours", "samples", "violation5", "false_infeasible")
    by_problem = [[s for s in scores if s.problem == one] for one in dict.fromkeys(s.problem for s in scores)]
    return {
        "kind": kind,
        "problems": len(by_problem),
        **{name: float(np.mean([s.ok[i] for s in scores])) for i, name in enumerate(WITHIN)},
        **{name: float(np.mean([getattr(s, name) for s in scores])) for name in means},
        "error": {
            "ok5": _standard_error([[s.ok[1] for s in some] for some in by_problem]),
            "bench": _standard_error([[s.bench for s in some] for some in by_problem]),
        },
        "regret": {
            "mean": float(regret.mean()) if len(regret) else None,
            **{f"p{q:g}": float(np.quantile(regret, q / 100)) if len(regret) else None for q in (50, 90, 99)},
        },
        "mdape": float(np.mean(errors)) if errors else None,
        "coverage90": sum(s.covered for s in scores) / predicted if predicted else None,
    }


def _standard_error(values: Sequence[Sequence[float]]) -> float | None:
    """Return the standard error of the mean over problems, whose settings and seeds are not independent."""
    means = [float(np.mean(some)) for some in values]
    return float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else None


def calibration(scores: Sequence[Score]) -> list[dict[str, float]]:
    """Return rows of {p, met, machines}: the share that meets the limits, of the machines stated to do so with about p."""
    total = np.sum([s.stated for s in scores], axis=0)
    return [{"p": p / n, "met": met / n, "machines": int(n)} for p, met, n in total.tolist() if n]
