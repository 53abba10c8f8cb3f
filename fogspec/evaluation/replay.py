"""The replay of a problem: its noise, the meter that every sample is paid to, and the result of a run."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fogspec.choice.rule import Rule, Selection
from fogspec.evaluation.suites import Problem
from fogspec.model.predict import Predictions
from fogspec.numerics.acquisition import Policy
from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.nested import (
    MEDIAN_ALONE,
    MEDIAN_SHARED,
    NORMAL_80,
    P90_ALONE,
    P90_SHARED,
    Parts,
    one_thread_per_core,
)
from fogspec.numerics.observations import DEFAULT_NOISE, Observations, observations
from fogspec.numerics.surrogate import Posterior, Prior, Space, prepare

REPEATS = 8  # noise is drawn for so many samples of each machine; further samples start over


@dataclass(frozen=True, slots=True)
class Noise:
    """Factors (repeats, N) on the true latency, and on the metrics by name, which have none unless they are given.

    Those of `of` are exp(e), e ~ N(0, s), s per machine lognormal (median 0.015, sigma 0.95).
    """

    factor: Floats
    metrics: Mapping[str, Floats] = field(default_factory=dict)

    @classmethod
    def of(cls, problem: Problem, kind: str, seed: int) -> "Noise":
        """Return `realistic` noise, seeded by the problem's id and `seed`, or `none`."""
        n = len(problem.rows)
        if kind == "none":
            return cls(np.ones((REPEATS, n)))
        digest = hashlib.sha256(f"{seed}|{problem.id}".encode()).digest()
        random = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        sd = 0.015 * np.exp(0.95 * random.standard_normal(n))
        return cls(np.exp(sd * random.standard_normal((REPEATS, n))))


def nested_factors(problem: Problem, machines: Machines, seed: int) -> Floats:
    """Return the factor (N, N) by which the latency of each machine is off if it is measured as a part of each other one.

    Its absolute logarithm is drawn from the lognormal distribution with the median and 90th percentile of the source
    (`fogspec.numerics.nested`), seeded by the problem's id and `seed`.
    """
    digest = hashlib.sha256(f"{seed}|{problem.id}|nested".encode()).digest()
    random = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    n = len(machines)
    alone = one_thread_per_core(machines)
    median, p90 = np.where(alone, MEDIAN_ALONE, MEDIAN_SHARED), np.where(alone, P90_ALONE, P90_SHARED)
    size = median * np.exp(np.log(p90 / median) / NORMAL_80 * random.standard_normal((n, n)))
    return np.asarray(np.exp(size * random.choice((-1, 1), (n, n))))


@dataclass
class Meter:
    """The only access to a machine's latency: a paid sample, of its parts as well where `nested` factors (N, N) are known."""

    problem: Problem
    price: Floats
    noise: Noise
    parts: Parts | None = None
    nested: Floats | None = None
    sampled: list[int] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    told: list[tuple[int, float]] = field(default_factory=list)
    paid: float = 0.0
    metrics: dict[str, list[float]] = field(default_factory=dict)

    def sample(self, machine: int, parts: Sequence[int] = ()) -> float:
        """Pay for one more sample of a machine and return its latency; every repeat has noise of its own.

        The machines that its `parts` stand for are reported, each with the error of a part.
        """
        again = self.sampled.count(machine) % len(self.noise.factor)
        latency = float(self.problem.latency_s[machine] * self.noise.factor[again, machine])
        for name, truth in self.problem.metrics.items():
            factor = self.noise.metrics[name][again, machine] if name in self.noise.metrics else 1.0
            self.metrics.setdefault(name, []).append(float(truth[machine] * factor))
        self.sampled.append(machine)
        self.latency_s.append(latency)
        self.paid += float(self.price[machine])
        if self.parts is not None and self.nested is not None:
            self.paid += self.parts.share * len(parts) * float(self.price[machine])
            factor = self.nested[machine] * self.noise.factor[-1 - again]
            self.told += [(part, float(self.problem.latency_s[part] * factor[part])) for part in parts]
        return latency

    @property
    def observations(self) -> Observations:
        """What was measured: samples, then parts."""
        at = [row for row, _ in self.told]
        error = [] if self.parts is None else np.hypot(self.parts.error[at], DEFAULT_NOISE).tolist()
        own = len(self.sampled)
        return observations(
            [*self.sampled, *at],
            [*self.latency_s, *(latency_s for _, latency_s in self.told)],
            [*([np.nan] * own), *error],
            nested=[*([False] * own), *([True] * len(at))],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """The choice of a method, and its predictions of log-latency with their 90 % intervals (N,), NaN where it has none.

    `metrics` are the predicted values (N,) of the metrics.
    """

    chosen: int | None
    sampled: tuple[int, ...]
    paid: float
    log_latency: Floats
    low: Floats
    high: Floats
    probability_met: Floats
    metrics: Mapping[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """A problem with its machines, its noise and the model's space, which all settings share."""

    problem: Problem
    machines: Machines
    noise: Noise
    space: Space
    _fits: dict[tuple[tuple[int, ...], tuple[int, ...]], Posterior] = field(
        default_factory=dict, repr=False, compare=False
    )

    @classmethod
    def of(cls, problem: Problem, machines: Machines, prior: Prior | None, noise: Noise) -> "Case":
        """Prepare the model's space."""
        return cls(problem, machines, noise, prepare(machines, prior))

    def meter(self, parts: Parts | None = None, nested: Floats | None = None) -> Meter:
        """Return a new meter: nothing sampled, nothing paid; with `parts` and factors also of parts of machines."""
        return Meter(self.problem, self.machines.price_usd_per_hour, self.noise, parts, nested)

    def selection(self, meter: Meter, rule: Rule) -> Selection:
        """Return the rule applied to the model's predictions, given the paid samples."""
        found = {
            name: self.space.fit(observations(meter.sampled, meter.metrics.get(name, [])))
            for name in self.problem.metrics
        }
        return Selection(
            rule=rule,
            latency=Predictions.of_posterior(self.posterior(meter)),
            metrics={name: Predictions.of_posterior(one, varies_by_server=False) for name, one in found.items()},
        )

    def posterior(self, meter: Meter) -> Posterior:
        """Return the model's posterior given the paid samples.

        Kept are the fits that settings share, of the first batch and of a sweep, and the latest one.
        """
        key = tuple(meter.sampled), tuple(row for row, _ in meter.told)
        if key not in self._fits:
            for old in [one for one in self._fits if Policy().first < len(one[0]) < len(self.machines)]:
                del self._fits[old]
            self._fits[key] = self.space.fit(meter.observations)
        return self._fits[key]
