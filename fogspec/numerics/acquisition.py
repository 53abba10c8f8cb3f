"""Which machines to measure next, and when to stop. The rule of the choice is the caller's: `fogspec.choice.rule`."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fogspec.numerics.kernels import Floats
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.numerics.replicates import after_one_more
from fogspec.numerics.surrogate import Posterior


class Question(Protocol):
    """The objective and limits that the sampler serves."""

    @property
    def confidence(self) -> float:
        """The probability with which a machine must meet the limits to be chosen."""

    def drawn(self, posterior: Posterior) -> Floats:
        """What each machine is worth in each joint draw (S, N), small being good; infinite where it breaks a limit."""


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
        return initial_wave(
            posterior, sample_cost=sample_cost, left=left, count=min(policy.first, room), untried=untried
        )
    usable = untried | (allowed & posterior.measured & (posterior.samples < policy.each))
    if not usable.any():
        return Wave((), "every machine was measured")
    if sample_cost[usable].min() > left:
        return _too_dear(sample_cost, usable, left)
    return _improving(posterior, question, sample_cost, left, usable, policy, min(policy.wave, room))


def initial_wave(
    posterior: Posterior,
    *,
    sample_cost: Floats,
    left: float = np.inf,
    count: int | None = None,
    untried: np.ndarray | None = None,
) -> Wave:
    """Return the first machines to measure: those that take most variance off all machines for their price.

    Only `untried` (N,) machines are measured, all of them if None.
    """
    untried = np.ones(len(sample_cost), dtype=bool) if untried is None else untried.copy()
    if not untried.any():
        return Wave((), "every machine was measured")
    if sample_cost[untried].min() > left:
        return _too_dear(sample_cost, untried, left)
    return _spread(posterior, sample_cost, left, untried, count or Policy().first)


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
    now = _expected(value[:, at], question.confidence)
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


def _expected(value: Floats, confidence: float) -> Floats:
    """Return the mean over the draws (S, M) that meet the limits, infinite for machines that meet them in too few."""
    met = np.isfinite(value)
    mean = np.where(met, value, 0.0).sum(0) / np.maximum(met.sum(0), 1)
    return np.where(met.mean(0) >= confidence, mean, np.inf)


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
