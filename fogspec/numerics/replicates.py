"""Replicate noise: the distribution of a machine's estimate after one more sample of it.

Repeated benchmarks of one instance type have a heavy-tailed coefficient of variation, with a median of 1.5% and a 90th
percentile of 4.5% (Spare Cores' public benchmarks). The noise of a machine is therefore unknown, and the best of many
single samples is partly the luckiest.
"""

from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import numpy as np

from fogspec.numerics.kernels import Floats, quantised
from fogspec.numerics.observations import NOISE_SPREAD, SCALES, TYPICAL_NOISE, pooled
from fogspec.numerics.surrogate import Posterior

FLAT = 0.01  # precision of log-latency below which the other machines are uninformative


@dataclass(frozen=True, slots=True)
class Estimates:
    """The distribution of the estimated log-latency of the M measured machines `at` after one more sample of each.

    `log_latency` (S, M) are possible estimates and `probability` (S, M) their probabilities; each column sums to 1.
    """

    at: np.ndarray
    log_latency: Floats
    probability: Floats


def after_one_more(posterior: Posterior) -> Estimates:
    """Return the possible estimates of each measured machine, as many as the posterior has draws.

    The noise of a machine is averaged over its posterior given its samples and the other machines; the variance of the new
    estimate is the variance that one more sample removes (knowledge gradient: Frazier, Powell and Dayanik, SIAM J. Control
    Optim. 47 (2008) 2410).
    """
    at, value, variance = pooled(posterior.observations)
    themselves = posterior.measured[at]
    at, value, variance = at[themselves], value[themselves], variance[themselves]
    count = len(posterior.draws)
    which = np.arange(count) * len(SCALES) // count
    each = np.bincount(which)
    normal = np.concatenate([_normal_quantiles(int(n)) for n in each])
    table, probability = np.empty((2, count, len(at)))
    for i, machine in enumerate(at):
        samples = posterior.observations
        own = np.log(samples.latency_s[samples.own & (samples.machine == machine)])
        others = _without(posterior, int(machine), float(value[i]), float(variance[i]))
        weight, centre, moves = _by_noise(own, float(value[i]), *others)
        table[:, i] = centre[which] + moves[which] * normal
        probability[:, i] = (weight / each)[which]
    return Estimates(at, quantised(table), quantised(probability))


def _without(posterior: Posterior, machine: int, value: float, noise: float) -> tuple[float, float]:
    """Return the mean and variance given only the other machines: each model's posterior without the machine's samples."""
    mean, variance = posterior.means[:, machine], posterior.variances[:, machine]
    precision = 1 / variance - 1 / noise
    informative = precision > FLAT
    left = np.where(informative, precision, FLAT)
    means = np.where(informative, (mean / variance - value / noise) / left, value)
    middle = float(posterior.weights @ means)
    return middle, float(posterior.weights @ (1 / left + (means - middle) ** 2))


def _by_noise(own: Floats, value: float, mean: float, variance: float) -> tuple[Floats, Floats, Floats]:
    """Return for each scale of the noise its probability, the estimate, and the standard deviation of its change."""
    sd, n = TYPICAL_NOISE * np.exp(NOISE_SPREAD * SCALES), len(own)
    total = variance + sd**2 / n
    log = -0.5 * SCALES**2 - 0.5 * (value - mean) ** 2 / total - 0.5 * np.log(total)
    log -= 0.5 * ((own - own.mean()) ** 2).sum() / sd**2 + (n - 1) * np.log(sd)
    weight = np.exp(log - log.max())
    now, after = (variance * noise / (variance + noise) for noise in (sd**2 / n, sd**2 / (n + 1)))
    return weight / weight.sum(), mean + variance / total * (value - mean), np.sqrt(now - after)


@cache
def _normal_quantiles(count: int) -> Floats:
    """Return the medians of equally likely parts of the standard normal distribution, (count,)."""
    return np.array([NormalDist().inv_cdf((i + 0.5) / count) for i in range(count)])
