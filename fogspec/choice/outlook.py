"""Where no machine qualifies: the sample that may still change it, or why none can.

A machine may qualify after one more sample if its limits then leave room for its own error and for another server of its type.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fogspec.choice.choose import Choice
from fogspec.choice.rule import Rows, Selection
from fogspec.model.predict import PredictionSet
from fogspec.numerics.acquisition import Policy
from fogspec.numerics.kernels import Floats, quantised
from fogspec.numerics.normal import normal_cdf
from fogspec.numerics.observations import DEFAULT_NOISE, SYSTEMATIC_NOISE
from fogspec.numerics.prediction import Prediction
from fogspec.plan.initial_batch import SampleCosts

MIN_CHANCE = 0.05  # that a sample lets a machine qualify, from which on it is worth its cost
OF_A_SAMPLE = math.hypot(DEFAULT_NOISE, SYSTEMATIC_NOISE)  # standard deviation of its log-latency

Cause = Literal["one sample", "too little known", "too little room", "too slow", "unknown"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outlook:
    """What stands between the machine in this row and the limits.

    `one sample` of it, for `usd` at most, may let it qualify, with probability `chance`; one may, but costs more than is left
    of the budget, or is unavailable (`usd` is None): `too little known`; or none can: it meets the limits as predicted with
    `too little room` for another server, or is `too slow`. It is `unknown` where nothing that was measured tells how sure
    the latency of machines on offer is.
    """

    cause: Cause
    row: int
    chance: float = 0.0
    usd: float | None = None


def chances(selection: Selection, rows: Rows) -> Floats:
    """Return the probability (N,) that each type qualifies after one more sample of it; `rows` (N,) is its offer."""
    rule, latency = selection.rule.take(rows), selection.latency
    if rule.confidence is None or latency.distribution is None:
        return np.zeros(len(rows))
    targets: list[tuple[Prediction, Floats]] = [(latency.distribution.alone, rule.latency_budget_s)]
    for name, most in rule.max_metrics.items():
        if (own := selection.metrics[name].distribution) is None:
            return np.zeros(len(rows))
        targets.append((own, np.full(len(rows), most)))
    met = [one.probability_below(bound) for one, bound in targets]
    found: Floats = np.ones(len(rows))
    for number, (one, bound) in enumerate(targets):
        # What is not settled of the others is so after a sample; what is settled takes its share of the probability.
        others = [np.where(p >= rule.confidence, p, 1.0) for at, p in enumerate(met) if at != number]
        level = np.minimum(rule.confidence / np.prod(others, axis=0), 1 - 1e-6)
        found *= _chance(one, bound, np.broadcast_to(level, len(rows)))
    return quantised(found)


def _chance(one: Prediction, bound: Floats, level: Floats) -> Floats:
    """Return the probability (N,) that a value is at most the bound with probability `level` after one more sample."""
    variance = one.sigma**2
    after = variance * OF_A_SAMPLE**2 / (variance + OF_A_SAMPLE**2)
    room = np.log(replace(one, mu=np.zeros_like(one.mu), sigma=np.sqrt(after)).quantile(level))
    with np.errstate(divide="ignore"):
        return normal_cdf((np.log(bound) - one.mu - room) / np.sqrt(variance - after))


def deciding(chance: Floats, usd: Floats, possible: np.ndarray) -> int | None:
    """Return the possible type (N,) whose sample is most likely to settle it per dollar; None if none is likely enough."""
    worth = np.where(possible & (chance >= MIN_CHANCE), chance / np.where(usd > 0, usd, usd.max() or 1.0), 0.0)
    return int(np.argmax(quantised(worth))) if worth.any() else None


def outlook(
    predicted: PredictionSet, choice: Choice, costs: SampleCosts, excluded: np.ndarray, left_usd: float
) -> Outlook | None:
    """Return the outlook of a choice; None where a machine is chosen, or none can be predicted.

    `costs` are those of one sample of each of the N types; `excluded` (N,) types cannot be measured. With the relaxed method
    only the machine where it ends counts.
    """
    rows = np.flatnonzero(choice.eligible)
    if choice.chosen is not None or not len(rows):
        return None
    if choice.confidence is None:
        return Outlook(cause="too slow", row=_first(choice, rows))
    if choice.latency.distribution is None:
        known = rows[choice.latency.measured[rows]]
        rows = known if len(known) else rows
        return Outlook(cause="unknown", row=int(rows[np.argmin(choice.objective[rows])]))
    end = choice.relaxed_row if choice.by_relaxation else None
    if choice.by_relaxation and end is None:
        return Outlook(cause="too slow", row=_first(choice, rows))
    posterior, types = choice.latency.posterior, predicted.types
    offered = types.offer < len(choice.offers)
    chance = chances(choice, np.where(offered, types.offer, 0))
    possible = offered & ~excluded & (True if posterior is None else posterior.samples < Policy().each)
    if end is not None:
        possible &= np.arange(len(possible)) == types.of[end]
    cause: Cause = "one sample"
    one = deciding(chance, costs.usd, possible & (costs.usd <= left_usd))
    if one is None:
        cause, one = "too little known", deciding(chance, costs.usd, possible)
    if one is not None:
        row = int(costs.row[one]) if end is None else end
        return Outlook(cause=cause, row=row, chance=float(chance[one]), usd=float(costs.usd[one]))
    row = _first(choice, rows) if end is None else end
    if not choice.satisfied[row]:
        return Outlook(cause="too slow", row=row)
    return Outlook(cause="too little room" if choice.latency.measured[row] else "too little known", row=row)


def _first(choice: Choice, rows: Rows) -> int:
    """Return the most probable machine of those that meet the limits as predicted, measured ones first, else the nearest."""
    for some in (choice.satisfied & choice.latency.measured, choice.satisfied):
        if some.any():
            met = [choice.probability(int(row)) or 0.0 for row in np.flatnonzero(some)]
            return int(np.flatnonzero(some)[int(np.argmax(met))])
    nearest = choice.least_infeasible
    return int(rows[0]) if nearest is None else nearest
