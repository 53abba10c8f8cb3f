"""The replay of a problem: its noise, the meter that every sample is paid to, and the result of a run."""

import hashlib
import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fogspec.agent.intervals import STRICT, error_of, interval
from fogspec.agent.stopping import LEAST
from fogspec.backends.skypilot.backend import AT_ONCE
from fogspec.choice.rule import Rule, Selection
from fogspec.model.predict import Predictions
from fogspec.numerics.acquisition import Batch, Policy, propose_batch
from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.observations import DEFAULT_NOISE, Observations, observations
from fogspec.numerics.surrogate import Posterior, Prior, Space, prepare
from fogspec_lab.evaluation.suites import Problem

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


@dataclass(frozen=True, slots=True)
class Timing:
    """The requests of a sample, which say what it takes and when it is decided (ADR 0028).

    A request takes `request_s` on the machine in the middle of a problem, without it what was measured, and varies by `spread`
    (relative, lognormal); without `spread` samples run to their end. A sample ends after `requests` or `duration_s`;
    `before_s` is paid until the first request.
    """

    request_s: float | None = 1.0
    spread: float | None = 0.1
    requests: float = 200
    duration_s: float = 300.0
    before_s: float = 159.0

    def scale(self, problem: Problem) -> float:
        """Return the seconds of this timing for a second of a problem."""
        return 1.0 if self.request_s is None else self.request_s / float(np.median(problem.latency_s))

    def whole_s(self, latency_s: Floats) -> Floats:
        """Return the seconds that are paid for samples that run to their end, set-up included."""
        return self.before_s + np.minimum(self.requests * latency_s, self.duration_s)

    def decided(self, latency_s: float, above: float, random: np.random.Generator) -> tuple[float, float, float] | None:
        """Return the mean over `latency_s`, its relative standard error, and the seconds that are paid.

        `latency_s` is in the seconds of this timing, and so is the latency that decides, which is `above` times it. None for a
        sample that is not decided before its end. Checked when the agent checks (`fogspec.agent.intervals`).
        """
        most = min(self.requests, math.floor(self.duration_s / latency_s))
        if self.spread is None or most < LEAST:
            return None
        values = np.exp(self.spread * random.standard_normal(int(most)) - self.spread**2 / 2)
        checks, at = [], LEAST
        while at < most:
            checks.append(at)
            at = math.ceil(at * 1.05) + 1
        # No interval begins above its mean, which takes far less to compute than an interval.
        means = np.cumsum(values) / np.arange(1, len(values) + 1)
        for n in checks:
            if means[n - 1] <= above:
                continue
            found = interval(values[:n].tolist(), "mean", STRICT)
            if found.low > above:
                return found.value, error_of(values[:n].tolist(), "mean"), self.before_s + n * latency_s
        return None


@dataclass
class Meter:
    """The only access to a machine's latency: paid samples, in batches that are measured side by side.

    `seconds` are what each sample was paid for, `batch` the number of its batch; both with set-up.
    """

    problem: Problem
    price: Floats
    noise: Noise
    timing: Timing
    sampled: list[int] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    batch: list[int] = field(default_factory=list)
    metrics: dict[str, list[float]] = field(default_factory=dict)

    def measure(self, machines: Sequence[int], above_s: Mapping[int, float] | None = None) -> list[float]:
        """Pay for one more sample of each machine, side by side, and return the latencies; every repeat has its own noise.

        The first sample of a machine in `above_s` ends early when it is certainly above that.
        """
        number, ends = self.batch[-1] + 1 if self.batch else 0, dict(above_s or {})
        self.batch += [number] * len(machines)
        return [self._sample(machine, ends.pop(machine, np.inf)) for machine in machines]

    def _sample(self, machine: int, above_s: float) -> float:
        again = self.sampled.count(machine) % len(self.noise.factor)
        latency = float(self.problem.latency_s[machine] * self.noise.factor[again, machine])
        scale = self.timing.scale(self.problem)
        error, seconds = np.nan, float(self.timing.whole_s(np.array(latency * scale)))
        if np.isfinite(above_s):
            found = self.timing.decided(latency * scale, above_s / latency, self._random(machine))
            if found is not None:
                factor, error, seconds = found
                latency, error = latency * factor, float(np.hypot(error, DEFAULT_NOISE))
        self.error.append(error)
        for name, truth in self.problem.metrics.items():
            factor = self.noise.metrics[name][again, machine] if name in self.noise.metrics else 1.0
            self.metrics.setdefault(name, []).append(float(truth[machine] * factor))
        self.sampled.append(machine)
        self.latency_s.append(latency)
        self.seconds.append(seconds)
        return latency

    def _random(self, machine: int) -> np.random.Generator:
        digest = hashlib.sha256(f"{self.problem.id}|{machine}|requests".encode()).digest()
        return np.random.default_rng(int.from_bytes(digest[:8], "big"))

    @property
    def steps(self) -> list[int]:
        """How many samples there were after each batch; of a single batch all counts."""
        ends = [at for at in range(1, len(self.batch)) if self.batch[at] != self.batch[at - 1]]
        return [*(ends or range(1, len(self.batch))), *([len(self.batch)] if self.batch else [])]

    def until(self, count: int) -> "Meter":
        """Return this meter as it was after so many samples."""
        lists = ("sampled", "latency_s", "error", "seconds", "batch")
        metrics = {name: values[:count] for name, values in self.metrics.items()}
        return replace(self, **{name: getattr(self, name)[:count] for name in lists}, metrics=metrics)

    @property
    def observations(self) -> Observations:
        """What was measured."""
        return observations(self.sampled, self.latency_s, self.error)

    @property
    def bill(self) -> "Bill":
        """What the samples cost."""
        whole_s = self.timing.whole_s(self.problem.latency_s * self.timing.scale(self.problem))
        price, seconds, batch = self.price, np.array(self.seconds), np.array(self.batch)
        usd = float(price[self.sampled] @ seconds) / 3600 if self.sampled else 0.0
        wall_s = sum(wall_time_s(seconds[batch == one].tolist()) for one in {*self.batch})
        return Bill(
            sampled=tuple(self.sampled),
            seconds=tuple(self.seconds),
            batch=tuple(self.batch),
            usd=usd,
            sweep_usd=float(price @ whole_s) / 3600,
            wall_s=wall_s,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Bill:
    """The sampled machines, the seconds that each sample was paid for and its batch; with set-up, as everything here.

    `usd` is their cost, `sweep_usd` that of a whole sample of every machine; `wall_s` is the time of all batches.
    """

    sampled: tuple[int, ...]
    seconds: tuple[float, ...]
    batch: tuple[int, ...]
    usd: float
    sweep_usd: float
    wall_s: float


def wall_time_s(seconds: Sequence[float]) -> float:
    """Return the time of samples that start in this order, as many at once as `fogspec bench` starts on a cloud."""
    ends = [0.0] * AT_ONCE
    for one in seconds:
        heapq.heapreplace(ends, ends[0] + one)
    return max(ends)


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """The choice of a method, and its predictions of log-latency with their 90% intervals (N,), NaN where it has none.

    `metrics` are the predicted values (N,) of the metrics.
    """

    chosen: int | None
    bill: Bill
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
    timing: Timing
    _fits: dict[tuple[tuple[int, ...], tuple[float, ...]], Posterior] = field(
        default_factory=dict, repr=False, compare=False
    )

    _first: dict[Policy, Batch] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, problem: Problem, machines: Machines, prior: Prior | None, noise: Noise, timing: Timing) -> "Case":
        """Prepare the model's space."""
        return cls(problem, machines, noise, prepare(machines, prior), timing)

    def meter(self) -> Meter:
        """Return a new meter: nothing sampled, nothing paid."""
        return Meter(self.problem, self.machines.price_usd_per_hour, self.noise, self.timing)

    def proposed(self, meter: Meter, selection: Selection, policy: Policy) -> Batch:
        """Return the next machines to measure; the first ones do not depend on the setting, and are kept."""
        if not meter.sampled and policy in self._first:
            return self._first[policy]
        batch = propose_batch(
            self.posterior(meter),
            selection.utility(),
            sample_cost=self.machines.price_usd_per_hour,
            policy=policy,
        )
        return batch if meter.sampled else self._first.setdefault(policy, batch)

    @staticmethod
    def measure(meter: Meter, batch: Batch, selection: Selection) -> None:
        """Sample a batch; a machine that was not sampled before ends early when it cannot become this selection's best."""
        new = [machine for machine in dict.fromkeys(batch.machines) if machine not in meter.sampled]
        above_s = selection.decided_above_s(np.array(new, dtype=np.intp)) if new else None
        ends = {} if above_s is None else dict(zip(new, above_s.tolist(), strict=True))
        meter.measure(batch.machines, ends)

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
        key = tuple(meter.sampled), tuple(meter.latency_s)
        if key not in self._fits:
            for old in [one for one in self._fits if Policy().first < len(one[0]) < len(self.machines)]:
                del self._fits[old]
            self._fits[key] = self.space.fit(meter.observations)
        return self._fits[key]
