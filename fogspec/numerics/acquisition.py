"""Which machines to measure next, and when to stop. The rule of the choice is the caller's: `fogspec.choice.rule`."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fogspec.numerics.kernels import Floats, quantised
from fogspec.numerics.replicates import after_one_more
from fogspec.numerics.surrogate import Posterior


class Question(Protocol):
    """The objective and limits that the sampler serves."""

    @property
    def qualifies(self) -> np.ndarray:
        """Machines (N,) that would be chosen from: they meet the limits with the required probability."""

    @property
    def measured_first(self) -> bool:
        """Whether a machine that was not measured is chosen only if no measured one qualifies."""

    def loss(self, posterior: Posterior, rows: np.ndarray | None = None) -> Floats:
        """Return the loss of each machine in each joint draw, (S, N); infinite where it breaks a limit.

        With `rows` (M,) only that of the machines at these indices, (S, M).
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Policy:
    """The stopping rule and the sizes of batches.

    A machine of mean price is measured while its expected relative improvement of the objective is at least `min_gain`, in
    proportion for other prices; a measured one again, up to `each` times in total. Machines rank by expected improvement over
    this threshold. The first batch has `first` machines, later ones have `batch`.
    """

    min_gain: float = 0.009
    each: int = 6
    first: int = 3
    batch: int = 1

    def threshold(self, cost: Floats) -> Floats:
        """Return the expected improvement (N,) from which on a sample of each machine is worth its cost, measured or not."""
        return cost * (max(self.min_gain, 1e-12) / float(cost.mean()))


@dataclass(frozen=True, slots=True)
class Batch:
    """Machines to measure at once and the expected gain of each; none with the reason why sampling ends."""

    machines: tuple[int, ...]
    reason: str
    gains: tuple[float, ...] = ()


def propose_batch(
    posterior: Posterior,
    question: Question,
    *,
    sample_cost: Floats,
    left: float = np.inf,
    policy: Policy | None = None,
    excluded: np.ndarray | None = None,
) -> Batch:
    """Return the next machines to measure; `sample_cost` (N,) is the cost of one sample of each, `left` the budget.

    `excluded` (N,) machines are not proposed.
    The first batch has the cheapest machines; later batches maximise expected improvement under the limits per price
    (Alipourfard et al., CherryPick, NSDI 2017; Gelbart et al., Bayesian Optimization with Unknown Constraints, UAI 2014), with
    replicates of measured machines among the candidates.
    """
    policy = policy or Policy()
    sampled = posterior.observations.machine
    tried = np.unique(sampled)
    allowed = np.ones(len(sample_cost), dtype=bool) if excluded is None else ~excluded
    untried = allowed.copy()
    untried[tried] = False
    if not posterior.measured.any() and len(tried) < 2 * policy.first:
        return cheapest(sample_cost, left=left, count=policy.first, untried=untried)
    usable = untried | (allowed & posterior.measured & (posterior.samples < policy.each))
    if not usable.any():
        return Batch((), "every machine was measured")
    if sample_cost[usable].min() > left:
        return _too_expensive(sample_cost, usable, left)
    return _by_expected_gain(
        posterior,
        question,
        cost=sample_cost,
        left=left,
        usable=usable,
        policy=policy,
    )


def cheapest(
    sample_cost: Floats, *, left: float = np.inf, count: int | None = None, untried: np.ndarray | None = None
) -> Batch:
    """Return the first machines to measure: the cheapest of those `untried` (N,), all of them if None."""
    rows = np.argsort(sample_cost, kind="stable")
    if untried is not None:
        rows = rows[untried[rows]]
    if not len(rows):
        return Batch((), "every machine was measured")
    rows = rows[: count or Policy().first]
    affordable = rows[np.cumsum(sample_cost[rows]) <= left]
    if not len(affordable):
        return _too_expensive(sample_cost, rows, left)
    return Batch(tuple(affordable.tolist()), "the cheapest first")


def _too_expensive(cost: Floats, usable: np.ndarray, left: float) -> Batch:
    return Batch((), f"the cheapest further sample costs {cost[usable].min():.4g}, {left:.4g} is left")


def _by_expected_gain(
    posterior: Posterior,
    question: Question,
    *,
    cost: Floats,
    left: float,
    usable: np.ndarray,
    policy: Policy,
) -> Batch:
    """Return the samples of largest expected gain over the measured machines and those already in this batch."""
    value, known = question.loss(posterior), posterior.measured
    gained = _gains(posterior, question, value)
    best = np.min(value[:, known], axis=1, initial=np.inf)
    threshold = policy.threshold(cost)
    chosen: list[int] = []
    gains: list[float] = []
    for _ in range(policy.batch):
        if chosen and question.measured_first:
            gained = np.where(known, gained, expected_improvement(value, best))
        good = usable & (cost <= left) & (gained >= threshold)
        if not good.any():
            break
        pick = int(np.argmax(quantised(np.where(good, gained / threshold, -1.0))))
        chosen.append(pick)
        gains.append(float(gained[pick]))
        left -= float(cost[pick])
        usable[pick] = False
        if not known[pick]:
            best = np.minimum(best, value[:, pick])
    if not chosen:
        return Batch(
            (), f"no further sample is expected to improve the choice by {policy.min_gain:.1%} per mean price of one"
        )
    return Batch(tuple(chosen), "expected improvement per price", tuple(gains))


def expected_gains(posterior: Posterior, question: Question) -> Floats:
    """Return the relative improvement of the choice expected of one more sample of each machine, (N,)."""
    return _gains(posterior, question, question.loss(posterior))


def _gains(posterior: Posterior, question: Question, value: Floats) -> Floats:
    known = posterior.measured
    if question.measured_first:
        best = np.min(value[:, known], axis=1, initial=np.inf)
        return np.where(known, _replicate_gains(posterior, question, value), expected_improvement(value, best))
    known_exactly = _gains_of_knowing(value, question.qualifies)
    return np.where(known, _replicate_gains(posterior, question, value), known_exactly)


def _gains_of_knowing(value: Floats, qualifies: np.ndarray) -> Floats:
    """Return the expected relative improvement of a choice among all machines if one machine was known exactly, (N,).

    A machine gains where it turns out better than the leader; the leader where it turns out worse than the second. While
    no machine qualifies, a machine gains 1 where it meets the limits. The losses `value` (S, N) decide.
    """
    leader, mean, second = _leader(_expected(value, qualifies))
    if not np.isfinite(mean):
        return np.asarray(np.isfinite(value).mean(0))
    with np.errstate(invalid="ignore"):
        lost = np.where(np.isfinite(value[:, leader]), np.maximum(1 - second / value[:, leader], 0.0), 1.0)
    gained = np.maximum(1 - value / mean, 0.0).mean(0)
    gained[leader] = lost.mean()
    return np.asarray(gained)


def _leader(expected: Floats) -> tuple[int, float, float]:
    """Return the machine of the least expected loss, that loss, and the least of the others."""
    leader = int(np.argmin(expected))
    return leader, float(expected[leader]), float(np.min(np.delete(expected, leader), initial=np.inf))


def _replicate_gains(posterior: Posterior, question: Question, value: Floats) -> Floats:
    """Return the knowledge gradient of one more sample of each measured machine, (N,), 0 for the others.

    A sample of the leader gains where it shows that the second is better or that the leader breaks a limit; a sample of
    another machine gains where it shows that this machine is better than the leader.
    """
    found = np.zeros(value.shape[1])
    after = after_one_more(posterior)
    at, probability = after.at, after.probability
    if not len(at):
        return found
    updated = posterior.draws.copy()
    updated[:, at] = after.log_latency
    then = question.loss(replace(posterior, draw=lambda: updated), at)
    among = at if question.measured_first else np.arange(value.shape[1])
    leader, least, second = _leader(_expected(value[:, among], question.qualifies[among]))
    if not np.isfinite(least):
        found[at] = (probability * np.isfinite(then)).sum(0)
        return found
    found[at] = (probability * np.maximum(1 - then / least, 0.0)).sum(0)
    place = np.flatnonzero(at == among[leader])
    if len(place):
        own = then[:, place[0]]
        with np.errstate(invalid="ignore"):
            lost = np.where(np.isfinite(own), np.maximum(1 - second / own, 0.0), 1.0)
        found[among[leader]] = float(probability[:, place[0]] @ lost)
    return found


def _expected(value: Floats, qualifies: np.ndarray) -> Floats:
    """Return the typical loss (M,) in the draws (S, M) that meet the limits, infinite for machines that do not qualify.

    Typical is the geometric mean, as the choice goes by typical latencies: the mean of what is nearly unknown is its tail.
    """
    met = np.isfinite(value)
    log = np.log(np.where(met, np.maximum(value, 1e-300), 1.0)).sum(0) / np.maximum(met.sum(0), 1)
    return np.where(qualifies & met.any(0), np.exp(log), np.inf)


def expected_improvement(value: Floats, best: Floats) -> Floats:
    """Return the expected relative improvement (N,) over the best loss so far (S,); the first feasible machine gains 1."""
    known = np.isfinite(best)
    over = value / np.where(known, best, 1.0)[:, None]
    np.subtract(1.0, over, out=over)
    np.maximum(over, 0.0, out=over)
    if not known.all():
        over[~known] = np.isfinite(value[~known])
    return np.asarray(over.mean(0))
