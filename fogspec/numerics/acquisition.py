"""Which machines to measure next, and when to stop. The rule of the choice is the caller's: `fogspec.choice.rule`."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from fogspec.numerics.kernels import Floats
from fogspec.numerics.nested import Parts
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.numerics.replicates import after_one_more
from fogspec.numerics.surrogate import Posterior

MOST_SHARE = 10  # one in so many machines of a whole catalog may be measured
SURPRISES = 64  # with a volume, one draw in so many is a surprise:
SURPRISE = 4.0  # so many times farther off,
MOST_SURPRISE = 0.6  # to a standard deviation of log-latency of at most this
MORE_LIKELY_THAN_NOT = 0.5  # the probability of meeting the limits below which no machine is chosen


class Question(Protocol):
    """The objective and limits that the sampler serves."""

    @property
    def confidence(self) -> float:
        """The probability with which a machine must meet the limits to be chosen."""

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

    A machine of mean price is measured while its expected relative improvement of the objective is at least `min_gain`,
    in proportion for other prices; a measured machine gets another sample, up to `each` in total, while the expected
    improvement is at least `min_repeat_gain` times its fraction of the price of a full sweep. Machines rank by expected
    improvement over this threshold. The initial design has `first` machines, later batches have `batch`; `most` bounds the
    number of samples, or a tenth of the machines if that is more.

    With `worth`, the value of an improvement of 1 in the unit of the costs, a sample of any machine must instead improve the
    objective by its cost over this, and the only bound is `most_with_worth` samples.
    """

    min_gain: float = 0.009
    min_repeat_gain: float = 0.2
    each: int = 6
    first: int = 3
    batch: int = 1
    most: int = 30
    worth: float | None = None
    most_with_worth: int = 300

    def bound(self, machines: int) -> int:
        """Return the number of samples, of so many machines, after which sampling ends in any case."""
        return max(self.most, machines // MOST_SHARE) if self.worth is None else self.most_with_worth

    def threshold(self, cost: Floats, measured: np.ndarray) -> Floats:
        """Return the expected improvement (N,) from which on a sample of each machine is worth its cost."""
        if self.worth is not None:
            return cost / max(self.worth, 1e-300)
        return np.asarray(cost * np.where(measured, self.min_repeat_gain / cost.sum(), self.min_gain / cost.mean()))


@dataclass(frozen=True, slots=True)
class Batch:
    """Machines to measure at once and the expected gain of each; none with the reason why sampling ends.

    `parts` of each are the machines that its parts stand for, to be measured with it.
    """

    machines: tuple[int, ...]
    reason: str
    gains: tuple[float, ...] = ()
    parts: tuple[tuple[int, ...], ...] = ()


def propose_batch(
    posterior: Posterior,
    question: Question,
    *,
    sample_cost: Floats,
    left: float = np.inf,
    policy: Policy | None = None,
    excluded: np.ndarray | None = None,
    nested: Parts | None = None,
) -> Batch:
    """Return the next machines to measure; `sample_cost` (N,) is the cost of one sample of each, `left` the budget.

    `excluded` (N,) machines are not proposed. With `nested`, parts of machines are measured with them where that pays.
    The first batch is an A-optimal design per price; later batches maximise expected improvement under the limits per
    price (Alipourfard et al., CherryPick, NSDI 2017; Gelbart et al., Bayesian Optimization with Unknown Constraints, UAI
    2014), with replicates of measured machines among the candidates.
    """
    policy = policy or Policy()
    themselves = posterior.observations.machine[~posterior.observations.nested]
    tried, room = np.unique(themselves), policy.bound(len(sample_cost)) - len(themselves)
    if room <= 0:
        return Batch((), f"{policy.bound(len(sample_cost))} samples were taken, the most allowed")
    allowed = np.ones(len(sample_cost), dtype=bool) if excluded is None else ~excluded
    untried = allowed.copy()
    untried[tried] = False
    if not posterior.measured.any() and len(tried) < 2 * policy.first:
        return initial_design(
            posterior,
            sample_cost=sample_cost,
            left=left,
            count=min(policy.first, room),
            untried=untried,
            nested=nested,
        )
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
        count=min(policy.batch, room),
        nested=nested,
    )


def initial_design(
    posterior: Posterior,
    *,
    sample_cost: Floats,
    left: float = np.inf,
    count: int | None = None,
    untried: np.ndarray | None = None,
    nested: Parts | None = None,
) -> Batch:
    """Return the first machines to measure: those that take most variance off all machines for their price.

    Only `untried` (N,) machines are measured, all of them if None; with `nested` what their parts tell counts.
    """
    untried = np.ones(len(sample_cost), dtype=bool) if untried is None else untried.copy()
    if not untried.any():
        return Batch((), "every machine was measured")
    if sample_cost[untried].min() > left:
        return _too_expensive(sample_cost, untried, left)
    return _a_optimal(posterior, sample_cost, left, untried, count or Policy().first, nested)


def _too_expensive(cost: Floats, usable: np.ndarray, left: float) -> Batch:
    return Batch((), f"the cheapest further sample costs {cost[usable].min():.4g}, {left:.4g} is left")


def _a_optimal(
    posterior: Posterior, cost: Floats, left: float, untried: np.ndarray, count: int, nested: Parts | None
) -> Batch:
    """Return a greedy A-optimal design: each machine removes the most variance of all machines for its price."""
    draws = (posterior.draws - posterior.draws.mean(0)) / np.sqrt(len(posterior.draws))
    chosen: list[int] = []
    parts: list[tuple[int, ...]] = []
    for _ in range(count):
        usable = untried & (cost <= left)
        if not usable.any():
            break
        # The covariance is draws.T @ draws; the sum of a column's squares does not need the full matrix.
        variance = (draws**2).sum(0)
        covered = draws @ draws.T @ draws
        removed = (covered * draws).sum(0) / (variance + DEFAULT_NOISE**2)
        total = cost.copy()
        groups: dict[int, tuple[int, ...]] = {}
        for row in np.flatnonzero(usable).tolist() if nested is not None else ():
            if nested is not None and (some := nested.worth(row, cost, variance, untried)):
                groups[row] = some
                total[row] *= 1 + nested.share * len(some)
                removed[row] = _removed(draws, covered, (row, *some), nested)
        best = _highest(np.where(usable, removed / total, -1.0), total)
        chosen.append(best)
        parts.append(groups.get(best, ()))
        left -= float(cost[best])
        untried[best] = False
        for row in (best, *parts[-1]):
            noise = DEFAULT_NOISE**2 + (0.0 if nested is None or row == best else float(nested.error[row]) ** 2)
            own = float((draws[:, row] ** 2).sum())
            known = draws[:, row] / np.sqrt(own)
            draws = draws - (1 - np.sqrt(noise / (own + noise))) * np.outer(known, known @ draws)
    return Batch(tuple(chosen), "spread over what is uncertain", parts=tuple(parts))


def _removed(draws: Floats, covered: Floats, group: tuple[int, ...], nested: Parts) -> float:
    """Return the variance of all machines that a sample of the first of a group removes, with the others as its parts."""
    some = draws[:, group]
    noise = DEFAULT_NOISE**2 + np.array([0.0, *(nested.error[row] ** 2 for row in group[1:])])
    return float(np.trace(np.linalg.solve(some.T @ some + np.diag(noise), some.T @ covered[:, group])))


def _by_expected_gain(
    posterior: Posterior,
    question: Question,
    *,
    cost: Floats,
    left: float,
    usable: np.ndarray,
    policy: Policy,
    count: int,
    nested: Parts | None,
) -> Batch:
    """Return the samples of largest expected gain over the measured machines and those already in this batch."""
    value, known = question.loss(posterior), posterior.measured
    gained = _gains(posterior, question, value)
    best = np.min(value[:, known], axis=1, initial=np.inf)
    threshold = policy.threshold(cost, known)
    if policy.worth is None:
        threshold = np.maximum(threshold, 1e-12 * cost / cost.mean())
    chosen: list[int] = []
    gains: list[float] = []
    for _ in range(count):
        if chosen and question.measured_first:
            gained = np.where(known, gained, expected_improvement(value, best))
        good = usable & (cost <= left) & (gained >= threshold)
        if not good.any():
            break
        pick = _highest(np.where(good, gained / threshold, -1.0), cost)
        chosen.append(pick)
        gains.append(float(gained[pick]))
        left -= float(cost[pick])
        usable[pick] = False
        if not known[pick]:
            best = np.minimum(best, value[:, pick])
    if not chosen and policy.worth is not None:
        return Batch((), "no further sample is expected to save its price")
    if not chosen:
        return Batch(
            (), f"no further sample is expected to improve the choice by {policy.min_gain:.1%} per mean price of one"
        )
    # A part is of use where the machine that it stands for would be asked for itself.
    told = posterior.nested | posterior.measured
    wanted = ~told & (gained >= threshold)
    parts = () if nested is None else tuple(nested.worth(one, cost, posterior.sd**2, wanted) for one in chosen)
    return Batch(tuple(chosen), "expected improvement per price", tuple(gains), parts)


def expected_gains(posterior: Posterior, question: Question) -> Floats:
    """Return the relative improvement of the choice expected of one more sample of each machine, (N,)."""
    return _gains(posterior, question, question.loss(posterior))


def _gains(posterior: Posterior, question: Question, value: Floats) -> Floats:
    known = posterior.measured
    if question.measured_first:
        best = np.min(value[:, known], axis=1, initial=np.inf)
        return np.where(known, _replicate_gains(posterior, question, value), expected_improvement(value, best))
    odd = question.loss(replace(posterior, draw=partial(_with_surprises, posterior)))
    known_exactly = _gains_of_knowing(value, odd, question.confidence)
    return np.where(known, _replicate_gains(posterior, question, value), known_exactly)


def _with_surprises(posterior: Posterior) -> Floats:
    """Return the draws with some of each machine that was not measured farther off: no model knows its own tails."""
    draws = posterior.draws
    odd = (np.arange(len(draws))[:, None] + np.arange(draws.shape[1])) % SURPRISES == 0
    odd &= ~posterior.measured
    farther = np.clip(MOST_SURPRISE / posterior.sd, 1.0, SURPRISE)
    return np.where(odd, posterior.mean + farther * (draws - posterior.mean), draws)


def _gains_of_knowing(value: Floats, odd: Floats, confidence: float) -> Floats:
    """Return the expected relative improvement of a choice among all machines if one machine was known exactly, (N,).

    A machine gains where it turns out better than the leader; the leader where it turns out worse than the second. While
    no machine is likely to meet the limits, a machine gains 1 where it does. The choice goes by the losses `value` (S, N); a
    machine turns out as in `odd` (S, N).
    """
    leader, mean, second = _leader(_expected(value, confidence))
    if not np.isfinite(mean):
        leader, mean, second = _leader(_expected(value, min(confidence, MORE_LIKELY_THAN_NOT)))
    if not np.isfinite(mean):
        return np.asarray(np.isfinite(odd).mean(0))
    with np.errstate(invalid="ignore"):
        lost = np.where(np.isfinite(odd[:, leader]), np.maximum(1 - second / odd[:, leader], 0.0), 1.0)
    gained = np.maximum(1 - odd / mean, 0.0).mean(0)
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
    leader, least, second = _leader(_expected(value[:, among], question.confidence))
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


def _expected(value: Floats, confidence: float) -> Floats:
    """Return the typical loss (M,) in the draws (S, M) that meet the limits, infinite for machines that meet them in too few.

    Typical is the geometric mean, as the choice goes by typical latencies: the mean of what is nearly unknown is its tail.
    """
    met = np.isfinite(value)
    log = np.log(np.where(met, np.maximum(value, 1e-300), 1.0)).sum(0) / np.maximum(met.sum(0), 1)
    return np.where(met.mean(0) >= confidence, np.exp(log), np.inf)


def _highest(score: Floats, cost: Floats) -> int:
    """Return the machine of the highest score; scores equal to six digits are a tie, which the lower cost decides."""
    with np.errstate(divide="ignore"):
        scale = 10.0 ** (5 - np.floor(np.log10(max(float(score.max()), 1e-300))))
    tied = np.flatnonzero(np.round(score * scale) == np.round(score.max() * scale))
    return int(tied[np.argmin(cost[tied])])


def expected_improvement(value: Floats, best: Floats) -> Floats:
    """Return the expected relative improvement (N,) over the best loss so far (S,); the first feasible machine gains 1."""
    known = np.isfinite(best)
    over = value / np.where(known, best, 1.0)[:, None]
    np.subtract(1.0, over, out=over)
    np.maximum(over, 0.0, out=over)
    if not known.all():
        over[~known] = np.isfinite(value[~known])
    return np.asarray(over.mean(0))
