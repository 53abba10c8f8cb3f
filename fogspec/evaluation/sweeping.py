"""One application's sweep, replayed: what a campaign would have paid, chosen and missed (the paper, section 4)."""

from typing import Any

import numpy as np

from fogspec.evaluation.answering import METHODS
from fogspec.evaluation.replay import Case, Run
from fogspec.evaluation.running import Campaign
from fogspec.evaluation.samplers import SAMPLERS
from fogspec.evaluation.scores import Score, score
from fogspec.numerics.features import Floats


def replayed(case: Case, names: tuple[str, ...], window_s: float, campaign: Campaign) -> dict[str, Any]:
    """Sample and choose on the only setting of the case; a sample of each machine is paid for `window_s` seconds."""
    setting = case.problem.settings[0]
    meter = SAMPLERS[campaign.sampler](case, setting, campaign.seed)
    done = METHODS[campaign.reads_with](case, setting, meter)
    truth, price = case.problem.latency_s, case.machines.price_usd_per_hour
    objective = case.objective(setting)
    scored = score(case.problem.kind, done, truth, price, objective)
    best = np.where(truth <= objective.limit_s, objective.value(truth), np.inf)
    usd = window_s / 3600
    return {
        "machines": len(names),
        "chosen": None if done.chosen is None else names[done.chosen],
        "best": names[int(best.argmin())] if np.isfinite(best).any() else None,
        "sampled": [names[i] for i in done.sampled],
        "samples": scored.samples,
        "cost_usd": done.paid * usd,
        "full_sweep_usd": float(price.sum()) * usd,
        **_shares(scored),
        "r2": _r2(done, truth),
        "frontier_deviation": _frontier_deviation(done, truth, price),
    }


def _shares(scored: Score) -> dict[str, Any]:
    known = {"regret": scored.regret, "mdape": scored.mdape, "hypervolume": scored.hypervolume}
    return {
        "bench": scored.bench,
        "ok1": scored.ok[0],
        "ok5": scored.ok[1],
        "ok10": scored.ok[2],
        "violation5": scored.violation5,
        "false_infeasible": scored.false_infeasible,
        **{name: float(value) if np.isfinite(value) else None for name, value in known.items()},
        "coverage90": scored.covered / scored.predicted if scored.predicted else None,
    }


def _r2(run: Run, truth_s: Floats) -> float | None:
    """Coefficient of determination of the predictions, over every machine that has one."""
    known = np.isfinite(run.log_latency)
    total = ((truth_s[known] - truth_s[known].mean()) ** 2).sum() if known.any() else 0.0
    if not total > 0:
        return None
    return float(1 - ((np.exp(run.log_latency[known]) - truth_s[known]) ** 2).sum() / total)


def _frontier_deviation(run: Run, truth_s: Floats, price: Floats) -> float | None:
    """Over every hourly budget: how much slower the machine predicted to be fastest is than the fastest, at most."""
    order = np.lexsort((truth_s, price))
    predicted = np.where(np.isfinite(run.log_latency), run.log_latency, np.inf)[order]
    if not np.isfinite(predicted).any():
        return None
    first = int(np.flatnonzero(np.isfinite(predicted))[0])
    truth = truth_s[order]
    fastest = np.minimum.accumulate(truth)
    leader = np.array([int(predicted[: i + 1].argmin()) for i in range(len(order))])
    return float((truth[leader] / fastest - 1)[first:].max())
