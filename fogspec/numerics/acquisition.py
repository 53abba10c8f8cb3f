"""Which machines to measure next, when to stop, and which one to choose."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fogspec.numerics.features import Floats
from fogspec.numerics.repeats import after_one_more
from fogspec.numerics.samples import DEFAULT_NOISE
from fogspec.numerics.surrogate import Posterior

SURE = 0.9  # share of draws within the limits from which on a machine counts as one to be chosen


class Question(Protocol):
    """What the sampler asks for."""

    def drawn(self, posterior: Posterior) -> Floats:
        """What each machine is worth in each joint draw (S, N), small being good; infinite where it breaks a limit."""


@dataclass(frozen=True, slots=True)
class Objective:
    """What is minimised, `slope * latency_s + offset` per machine (N,), and the latency each machine may have.

    Latency and cost are both linear in latency, so every limit becomes one on latency: `limit_s` (N,), infinite
    where nothing limits. `confidence` is the probability with which the limits must be met; with a `tolerance`
    above 0 that is asked of limits wider by that share.
    """

    slope: Floats
    offset: Floats
    limit_s: Floats
    confidence: float = 0.9
    tolerance: float = 0.0

    def value(self, latency_s: Floats) -> Floats:
        """The objective at these latencies, (..., N)."""
        return np.asarray(self.slope * latency_s + self.offset)

    def drawn(self, posterior: Posterior) -> Floats:
        """What each machine is worth in each joint draw (S, N); a measured one may use the limits' tolerance."""
        limit = self.limit_s * np.where(posterior.measured, 1 + self.tolerance, 1.0)
        latency = np.exp(posterior.draws)
        return np.where(latency <= limit, self.value(latency), np.inf)


def busy(
    price_usd_per_hour: Floats,
    *,
    alpha: float,
    scale_latency_s: float,
    scale_cost_usd: float,
    max_latency_s: float | None = None,
    max_cost_usd: float | None = None,
    confidence: float = 0.9,
    tolerance: float = 0.0,
) -> Objective:
    """alpha * L / scale_L + (1 - alpha) * C / scale_C with C = price / 3600 * L: only busy seconds are paid."""
    if not 0 <= alpha <= 1:
        raise ValueError(f"alpha lies between 0 and 1, got {alpha}")
    if not (scale_latency_s > 0 and scale_cost_usd > 0):
        raise ValueError("scales must be positive")
    per_second = price_usd_per_hour / 3600
    limit = np.full(len(per_second), np.inf if max_latency_s is None else max_latency_s)
    if max_cost_usd is not None:
        limit = np.minimum(limit, max_cost_usd / per_second)
    slope = alpha / scale_latency_s + (1 - alpha) * per_second / scale_cost_usd
    return Objective(slope, np.zeros(len(slope)), limit, confidence, tolerance)


def provisioned(
    price_usd_per_hour: Floats,
    *,
    requests_per_second: float,
    alpha: float,
    scale_latency_s: float,
    scale_cost_usd: float,
    max_latency_s: float | None = None,
    max_cost_usd: float | None = None,
    confidence: float = 0.9,
    tolerance: float = 0.0,
) -> Objective:
    """The same with C = price / 3600 / rate: the whole hour is paid, and a request may take at most 1 / rate."""
    if not requests_per_second > 0:
        raise ValueError("provisioned billing needs a positive request rate")
    cost = price_usd_per_hour / 3600 / requests_per_second
    base = busy(
        price_usd_per_hour, alpha=alpha, scale_latency_s=scale_latency_s, scale_cost_usd=scale_cost_usd,
        max_latency_s=max_latency_s, confidence=confidence,
    )  # fmt: skip
    limit = np.minimum(base.limit_s, 1 / requests_per_second)
    if max_cost_usd is not None:
        limit = np.where(cost <= max_cost_usd, limit, 0.0)
    slope = np.full(len(cost), alpha / scale_latency_s)
    return Objective(slope, (1 - alpha) * cost / scale_cost_usd, limit, confidence, tolerance)


@dataclass(frozen=True, slots=True)
class Policy:
    """How the sampler trades money for certainty.

    A machine of mean price is worth measuring while it is expected to improve the objective by `worth` (relative),
    one of another price in proportion; a measured one is worth a further sample, up to `each` in all, while that is
    expected to improve it by `again` times its share of the price of a full sweep. The most improvement for what is
    asked comes first. `first` machines are measured before the objective guides, `wave` at once, `most` samples in all.
    """

    worth: float = 0.009
    again: float = 0.2
    each: int = 3
    first: int = 3
    wave: int = 1
    most: int = 30

    def asked(self, cost: Floats, measured: np.ndarray) -> Floats:
        """The improvement (N,) from which on a sample of each machine is worth its cost."""
        return np.asarray(cost * np.where(measured, self.again / cost.sum(), self.worth / cost.mean()))


@dataclass(frozen=True, slots=True)
class Wave:
    """Machines to measure at once; none with the reason why sampling ends. `worth` is what each is expected to gain."""

    machines: tuple[int, ...]
    reason: str
    worth: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Chosen:
    """The chosen machine, or None.

    `probability_met` is the stated probability that it meets every limit; `verified` says whether it was measured,
    `sure` whether the asked confidence is reached (for None: that none meets them).
    """

    machine: int | None
    probability_met: float
    verified: bool
    sure: bool


def choose(posterior: Posterior, objective: Objective, *, measured_only: bool = True) -> Chosen:
    """The best machine by expected objective among those that meet the limits with the asked confidence.

    Where none reaches it, the best of those that are more likely than not to meet them. With `measured_only` a
    machine that was never measured is not chosen while a measured one qualifies.
    """
    met = posterior.probability_below(objective.limit_s)
    within = posterior.probability_below(objective.limit_s * (1 + objective.tolerance))
    value = objective.value(np.exp(posterior.mean))
    pools = (posterior.measured, ~posterior.measured) if measured_only else (np.ones(len(met), bool),)
    for floor in (objective.confidence, 0.5):
        for pool in pools:
            good = pool & (within >= floor)
            if good.any():
                best = int(np.argmin(np.where(good, value, np.inf)))
                sure = bool(within[best] >= objective.confidence)
                return Chosen(best, float(met[best]), bool(posterior.measured[best]), sure)
    return Chosen(None, float(met.max()), False, bool(met.max() < 1 - objective.confidence))


def next_wave(
    posterior: Posterior,
    question: Question,
    *,
    sample_cost: Floats,
    left: float = np.inf,
    policy: Policy | None = None,
    barred: np.ndarray | None = None,
) -> Wave:
    """The next machines to measure within the money left; `sample_cost` (N,) is what one sample of each costs.

    `barred` (N,) machines are not asked for.

    The first wave spreads over what is uncertain (A-optimal design per price), later waves follow expected
    improvement under the limits per price (Alipourfard et al., CherryPick, NSDI 2017; Gelbart et al., Bayesian
    Optimization with Unknown Constraints, UAI 2014), further samples of measured machines among them.
    """
    policy = policy or Policy()
    tried = np.unique(posterior.observations.machine)
    room = policy.most - len(posterior.observations.machine)
    if room <= 0:
        return Wave((), f"{policy.most} samples were taken, the most allowed")
    allowed = np.ones(len(sample_cost), dtype=bool) if barred is None else ~barred
    untried = allowed.copy()
    untried[tried] = False
    if not posterior.measured.any() and len(tried) < 2 * policy.first:
        if not untried.any():
            return Wave((), "every machine was measured")
        if sample_cost[untried].min() > left:
            return _too_dear(sample_cost, untried, left)
        return _spread(posterior, sample_cost, left, untried, min(policy.first, room))
    usable = untried | (allowed & posterior.measured & (posterior.samples < policy.each))
    if not usable.any():
        return Wave((), "every machine was measured")
    if sample_cost[usable].min() > left:
        return _too_dear(sample_cost, usable, left)
    return _improving(posterior, question, sample_cost, left, usable, policy, min(policy.wave, room))


def _too_dear(cost: Floats, usable: np.ndarray, left: float) -> Wave:
    return Wave((), f"the cheapest further sample costs {cost[usable].min():.4g}, {left:.4g} is left")


def _spread(posterior: Posterior, cost: Floats, left: float, untried: np.ndarray, count: int) -> Wave:
    """Greedy: the machine that takes most variance off all machines for its price, given those before it."""
    draws = (posterior.draws - posterior.draws.mean(0)) / np.sqrt(len(posterior.draws))
    chosen: list[int] = []
    for _ in range(count):
        usable = untried & (cost <= left)
        if not usable.any():
            break
        # The covariance is draws' draws; the sum of a column's squares needs no matrix of all machines.
        own = (draws**2).sum(0)
        taken = ((draws @ draws.T @ draws) * draws).sum(0) / (own + DEFAULT_NOISE**2)
        best = _first(np.where(usable, taken / cost, -1.0), cost)
        chosen.append(best)
        left -= float(cost[best])
        untried[best] = False
        known = draws[:, best] / np.sqrt(own[best])
        kept = np.sqrt(DEFAULT_NOISE**2 / (own[best] + DEFAULT_NOISE**2))
        draws = draws - (1 - kept) * np.outer(known, known @ draws)
    return Wave(tuple(chosen), "spread over what is uncertain")


def _improving(
    posterior: Posterior, question: Question, cost: Floats, left: float, usable: np.ndarray, policy: Policy, count: int
) -> Wave:
    """By what each sample is expected to gain over what was measured and asked for in the wave before it."""
    value, known = question.drawn(posterior), posterior.measured
    again = _again(posterior, question, value)
    best = np.min(value[:, known], axis=1, initial=np.inf)
    asked = np.maximum(policy.asked(cost, known), 1e-12 * cost / cost.mean())
    chosen: list[int] = []
    worth: list[float] = []
    for _ in range(count):
        expected = np.where(known, again, gain(value, best))
        good = usable & (cost <= left) & (expected >= asked)
        if not good.any():
            break
        pick = _first(np.where(good, expected / asked, -1.0), cost)
        chosen.append(pick)
        worth.append(float(expected[pick]))
        left -= float(cost[pick])
        usable[pick] = False
        if not known[pick]:
            best = np.minimum(best, value[:, pick])
    if not chosen:
        return Wave(
            (), f"no further sample is expected to improve the choice by {policy.worth:.1%} per mean price of one"
        )
    return Wave(tuple(chosen), "expected improvement per price", tuple(worth))


def gains(posterior: Posterior, question: Question) -> Floats:
    """What one sample of each machine is expected to improve the choice by (N,), relative."""
    value = question.drawn(posterior)
    best = np.min(value[:, posterior.measured], axis=1, initial=np.inf)
    return np.where(posterior.measured, _again(posterior, question, value), gain(value, best))


def _again(posterior: Posterior, question: Question, value: Floats) -> Floats:
    """What one more sample of each measured machine is expected to gain (N,), 0 for the others.

    One of the leader gains where it shows that the second is better, or that the leader breaks a limit; one of another
    gains where it shows that this is better than the leader.
    """
    found = np.zeros(value.shape[1])
    after = after_one_more(posterior)
    at, probability = after.at, after.probability
    if not len(at):
        return found
    shaken = posterior.draws.copy()
    shaken[:, at] = after.log_latency
    then = question.drawn(replace(posterior, draw=lambda: shaken))[:, at]
    now = _expected(value[:, at])
    leader = int(np.argmin(now))
    if not np.isfinite(now[leader]):
        found[at] = (probability * np.isfinite(then)).sum(0)
        return found
    second = np.min(np.delete(now, leader), initial=np.inf)
    found[at] = (probability * np.maximum(1 - then / now[leader], 0.0)).sum(0)
    with np.errstate(invalid="ignore"):
        lost = np.where(np.isfinite(then[:, leader]), np.maximum(1 - second / then[:, leader], 0.0), 1.0)
    found[at[leader]] = float(probability[:, leader] @ lost)
    return found


def _expected(value: Floats) -> Floats:
    """The mean over draws (S, M) of what meets the limits, infinite for machines that mostly do not."""
    met = np.isfinite(value)
    mean = np.where(met, value, 0.0).sum(0) / np.maximum(met.sum(0), 1)
    return np.where(met.mean(0) >= SURE, mean, np.inf)


def _first(score: Floats, cost: Floats) -> int:
    """The machine of the highest score; what differs in the seventh digit is a tie, which the lower cost decides."""
    with np.errstate(divide="ignore"):
        scale = 10.0 ** (5 - np.floor(np.log10(max(float(score.max()), 1e-300))))
    tied = np.flatnonzero(np.round(score * scale) == np.round(score.max() * scale))
    return int(tied[np.argmin(cost[tied])])


def gain(value: Floats, best: Floats) -> Floats:
    """Expected relative gain (N,) of each machine over the best so far (draws,); the first to meet the limits gains 1."""
    with np.errstate(invalid="ignore"):
        over = np.where(np.isfinite(best)[:, None], 1 - value / best[:, None], 1.0)
    return np.asarray(np.maximum(np.where(np.isfinite(value), over, 0.0), 0.0).mean(0))
