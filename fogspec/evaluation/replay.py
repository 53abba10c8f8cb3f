"""The replay of a problem: its noise, the meter that every sample is paid to, and the result of a run."""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from fogspec.evaluation.suites import Problem
from fogspec.numerics.acquisition import Policy
from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.observations import observations
from fogspec.numerics.surrogate import Posterior, Prior, Space, prepare

REPEATS = 8  # noise is drawn for so many samples of each machine; further samples start over


@dataclass(frozen=True, slots=True)
class Noise:
    """Factors (repeats, N) on the true latency: exp(e), e ~ N(0, s), s per machine lognormal (median 0.015, sigma 0.95)."""

    factor: Floats

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


@dataclass
class Meter:
    """The only access to a machine's latency: a paid sample."""

    truth_s: Floats
    price: Floats
    noise: Noise
    sampled: list[int] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)

    def sample(self, machine: int) -> float:
        """Pay for one more sample of a machine and return its latency; every repeat has noise of its own."""
        again = self.sampled.count(machine) % len(self.noise.factor)
        latency = float(self.truth_s[machine] * self.noise.factor[again, machine])
        self.sampled.append(machine)
        self.latency_s.append(latency)
        return latency

    @property
    def paid(self) -> float:
        """Sum of the prices of all samples."""
        return float(self.price[self.sampled].sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """The choice of a method, and its predictions of log-latency with their 90 % intervals (N,), NaN where it has none."""

    chosen: int | None
    sampled: tuple[int, ...]
    paid: float
    log_latency: Floats
    low: Floats
    high: Floats
    probability_met: Floats


@dataclass(frozen=True)
class Case:
    """A problem with its machines, its noise and the model's space, which all settings share."""

    problem: Problem
    machines: Machines
    noise: Noise
    space: Space
    _fits: dict[tuple[int, ...], Posterior] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, problem: Problem, machines: Machines, prior: Prior | None, noise: Noise) -> "Case":
        """Prepare the model's space."""
        return cls(problem, machines, noise, prepare(machines, prior))

    def meter(self) -> Meter:
        """Return a new meter: nothing sampled, nothing paid."""
        return Meter(self.problem.latency_s, self.machines.price_usd_per_hour, self.noise)

    def posterior(self, meter: Meter) -> Posterior:
        """Return the model's posterior given the paid samples.

        Kept are the fits that settings share, of the first batch and of a sweep, and the latest one.
        """
        key = tuple(meter.sampled)
        if key not in self._fits:
            for old in [one for one in self._fits if Policy().first < len(one) < len(self.machines)]:
                del self._fits[old]
            self._fits[key] = self.space.fit(observations(meter.sampled, meter.latency_s))
        return self._fits[key]
