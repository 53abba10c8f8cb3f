"""The replay of a problem: its noise, the meter that every sample is paid to, and the result of a run."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fogspec.agent.stopping import FIRST_CHECK, Z99, interval
from fogspec.choice.rule import Rule, Selection
from fogspec.evaluation.suites import Problem
from fogspec.model.predict import Predictions
from fogspec.numerics.acquisition import Batch, Policy, propose_batch
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


@dataclass(frozen=True, slots=True)
class Timing:
    """The requests of a sample, for samples that end when they are decided (ADR 0028).

    A request takes `request_s` on the machine in the middle of a problem, and varies by `spread` (relative, lognormal). A
    sample ends after `requests` or `duration_s`; `before_s` is paid until the first request.
    """

    request_s: float = 1.0
    spread: float = 0.1
    requests: int = 200
    duration_s: float = 300.0
    before_s: float = 159.0

    def decided(self, latency_s: float, above: float, random: np.random.Generator) -> tuple[float, float, float] | None:
        """Return the mean over `latency_s`, its relative standard error, and the share of a whole sample that is paid.

        `latency_s` is in the seconds of this timing, and so is the latency that decides, which is `above` times it. None for a
        sample that is not decided before its end. Checked when the agent checks (`fogspec.agent.stopping`).
        """
        most = min(self.requests, math.floor(self.duration_s / latency_s))
        if most < FIRST_CHECK:
            return None
        values = np.exp(self.spread * random.standard_normal(most) - self.spread**2 / 2)
        checks, at = [], FIRST_CHECK
        while at < most:
            checks.append(at)
            at = math.ceil(at * 1.05) + 1
        for n in checks:
            value, half = interval(values[:n].tolist(), "mean", Z99)
            if value - half > above:
                paid_s, whole_s = (self.before_s + count * latency_s for count in (n, most))
                return value, half / Z99, paid_s / whole_s
        return None


@dataclass
class Meter:
    """The only access to a machine's latency: a paid sample, of its parts as well where `nested` factors (N, N) are known.

    Without a `timing` samples do not end early.
    """

    problem: Problem
    price: Floats
    noise: Noise
    parts: Parts | None = None
    nested: Floats | None = None
    timing: Timing | None = None
    sampled: list[int] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    told: list[tuple[int, float]] = field(default_factory=list)
    paid: float = 0.0
    metrics: dict[str, list[float]] = field(default_factory=dict)

    def sample(self, machine: int, parts: Sequence[int] = (), above_s: float = np.inf) -> float:
        """Pay for one more sample of a machine and return its latency; every repeat has noise of its own.

        A sample that is certainly above `above_s` ends early. The machines that its `parts` stand for are reported, each with
        the error of a part.
        """
        again = self.sampled.count(machine) % len(self.noise.factor)
        latency = float(self.problem.latency_s[machine] * self.noise.factor[again, machine])
        error, share = np.nan, 1.0
        if self.timing is not None and np.isfinite(above_s):
            scale = self.timing.request_s / float(np.median(self.problem.latency_s))
            found = self.timing.decided(latency * scale, above_s / latency, self._random(machine))
            if found is not None:
                factor, error, share = found
                latency, error = latency * factor, float(np.hypot(error, DEFAULT_NOISE))
        self.error.append(error)
        for name, truth in self.problem.metrics.items():
            factor = self.noise.metrics[name][again, machine] if name in self.noise.metrics else 1.0
            self.metrics.setdefault(name, []).append(float(truth[machine] * factor))
        self.sampled.append(machine)
        self.latency_s.append(latency)
        self.paid += share * float(self.price[machine])
        if self.parts is not None and self.nested is not None:
            self.paid += self.parts.share * len(parts) * float(self.price[machine])
            factor = self.nested[machine] * self.noise.factor[-1 - again]
            self.told += [(part, float(self.problem.latency_s[part] * factor[part])) for part in parts]
        return latency

    def _random(self, machine: int) -> np.random.Generator:
        digest = hashlib.sha256(f"{self.problem.id}|{machine}|requests".encode()).digest()
        return np.random.default_rng(int.from_bytes(digest[:8], "big"))

    @property
    def observations(self) -> Observations:
        """What was measured: samples, then parts."""
        at = [row for row, _ in self.told]
        error = [] if self.parts is None else np.hypot(self.parts.error[at], DEFAULT_NOISE).tolist()
        own = len(self.sampled)
        return observations(
            [*self.sampled, *at],
            [*self.latency_s, *(latency_s for _, latency_s in self.told)],
            [*self.error, *error],
            nested=[*([False] * own), *([True] * len(at))],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """The choice of a method, and its predictions of log-latency with their 90% intervals (N,), NaN where it has none.

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
    timing: Timing | None = None
    _fits: dict[tuple[tuple[int, ...], tuple[int, ...], tuple[float, ...]], Posterior] = field(
        default_factory=dict, repr=False, compare=False
    )

    _first: dict[tuple[Policy, bool], Batch] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(
        cls, problem: Problem, machines: Machines, prior: Prior | None, noise: Noise, timing: Timing | None = None
    ) -> "Case":
        """Prepare the model's space."""
        return cls(problem, machines, noise, prepare(machines, prior), timing)

    def meter(self, parts: Parts | None = None, nested: Floats | None = None) -> Meter:
        """Return a new meter: nothing sampled, nothing paid; with `parts` and factors also of parts of machines."""
        return Meter(self.problem, self.machines.price_usd_per_hour, self.noise, parts, nested, self.timing)

    def proposed(self, meter: Meter, selection: Selection, policy: Policy) -> Batch:
        """Return the next machines to measure; the first ones do not depend on the setting, and are kept."""
        first = (policy, meter.parts is None)
        if not meter.sampled and first in self._first:
            return self._first[first]
        batch = propose_batch(
            self.posterior(meter),
            selection.utility(),
            sample_cost=self.machines.price_usd_per_hour,
            policy=policy,
            nested=meter.parts,
        )
        return batch if meter.sampled else self._first.setdefault(first, batch)

    @staticmethod
    def measure(meter: Meter, batch: Batch, selection: Selection) -> None:
        """Sample a batch; a machine that was not sampled before ends early when it cannot become this selection's best."""
        new = [machine for machine in dict.fromkeys(batch.machines) if machine not in meter.sampled]
        above_s = selection.decided_above_s(np.array(new, dtype=np.intp)) if new else None
        ends = {} if above_s is None else dict(zip(new, above_s.tolist(), strict=True))
        for i, machine in enumerate(batch.machines):
            # Of a machine that is in the batch twice, the first sample may end early.
            meter.sample(machine, batch.parts[i] if batch.parts else (), ends.pop(machine, np.inf))

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
        key = tuple(meter.sampled), tuple(row for row, _ in meter.told), tuple(meter.latency_s)
        if key not in self._fits:
            for old in [one for one in self._fits if Policy().first < len(one[0]) < len(self.machines)]:
                del self._fits[old]
            self._fits[key] = self.space.fit(meter.observations)
        return self._fits[key]
