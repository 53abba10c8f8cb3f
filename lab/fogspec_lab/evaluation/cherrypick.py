"""A baseline after CherryPick: a Gaussian process over machine features, expected improvement, stop at 10%.

Source: Alipourfard et al., CherryPick: Adaptively Unearthing the Best Cloud Configurations for Big Data Analytics,
NSDI 2017: Matérn-5/2, three quasi-random starts, expected improvement under the limits, no stop before six samples,
stop when the expected improvement is below 10% of the best.
"""

from collections.abc import Callable, Sequence

import numpy as np

from fogspec.choice.rule import Rule, Scale
from fogspec.numerics.kernels import Floats, Machines, hstack, one_hot, standardise
from fogspec.numerics.normal import normal_cdf

STARTS = 3
FEWEST = 6
MOST = 20
STOP_AT = 0.10
LENGTHS = (0.5, 1.0, 2.0, 4.0)
NOISE = 0.03


def cherrypick(
    machines: Machines,
    rule: Rule,
    scale: Scale,
    measure: Callable[[Sequence[int]], list[float]],
    random: np.random.Generator,
) -> None:
    """Pay for samples through `measure`, the first ones side by side, until the next one is not expected to gain 10%."""
    budget_s = rule.latency_budget_s
    features = _features(machines)
    distance = np.sqrt(((features[:, None, :] - features[None, :, :]) ** 2).sum(-1))
    at = _starts(distance, int(random.integers(len(machines))))
    log = np.log(measure(at)).tolist()
    while len(at) < min(MOST, len(machines)):
        mean, sd = _predict(distance, at, np.array(log))
        value = rule.value(np.exp(mean), scale)
        seen = rule.take(np.array(at)).value(np.exp(log), scale)
        feasible = np.exp(log) <= budget_s[at]
        gain = _gain(mean, sd, budget_s, value, float(np.min(seen[feasible], initial=np.inf)))
        gain[at] = -1.0
        best = int(gain.argmax())
        if len(at) >= FEWEST and gain[best] < STOP_AT:
            return
        at.append(best)
        log += np.log(measure([best])).tolist()


def _features(machines: Machines) -> Floats:
    size = np.log2(machines.vcpus)
    per_cpu = np.log2(machines.memory_gib / machines.vcpus)
    kinds = hstack(one_hot(machines.cpu_model), one_hot(machines.arch), one_hot(machines.gpu), one_hot(machines.cloud))
    return hstack(0.5 * size, 0.5 * per_cpu, 0.5 * standardise(np.log(machines.clock_ghz)), kinds)


def _starts(distance: Floats, first: int) -> list[int]:
    """Far apart: each the farthest from those before it."""
    at = [first]
    while len(at) < min(STARTS, len(distance)):
        at.append(int(distance[:, at].min(1).argmax()))
    return at


def _predict(distance: Floats, at: list[int], log: Floats) -> tuple[Floats, Floats]:
    """Mean and standard deviation of log-latency with the length scale of the largest evidence."""
    best = -np.inf, np.empty(0), np.empty(0)
    level, amplitude = log.mean(), max(float(log.var()), 0.01)
    for length in LENGTHS:
        scaled = np.sqrt(5.0) * distance / length
        kernel = amplitude * (1 + scaled + scaled**2 / 3) * np.exp(-scaled)
        inner = kernel[np.ix_(at, at)] + NOISE**2 * np.eye(len(at))
        solved = np.linalg.solve(inner, np.column_stack([log - level, kernel[at]]))
        evidence = -0.5 * float((log - level) @ solved[:, 0]) - 0.5 * float(np.linalg.slogdet(inner)[1])
        if evidence > best[0]:
            variance = amplitude - (kernel[:, at] * solved[:, 1:].T).sum(1)
            best = evidence, level + kernel[:, at] @ solved[:, 0], np.sqrt(np.maximum(variance, 1e-9))
    return best[1], best[2]


def _gain(mean: Floats, sd: Floats, budget_s: Floats, value: Floats, best: float) -> Floats:
    """Return the expected improvement over the best feasible sample, relative, times the probability to meet the limits."""
    met = normal_cdf((np.log(np.maximum(budget_s, 1e-300)) - mean) / sd)
    if not np.isfinite(best):
        return met
    centre = np.log(value) - np.log(best)
    z = -centre / sd
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    return np.asarray((-centre * normal_cdf(z) + sd * density) * met)
