"""A problem to be replayed: its noise, the meter that is paid for each sample, and what a run ends with."""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from fogspec.evaluation.suite import Problem, Setting, objective_of
from fogspec.numerics.acquisition import Objective
from fogspec.numerics.features import Floats, Machines
from fogspec.numerics.surrogate import Prior, Space, prepare

REPEATS = 8  # a machine's noise is drawn for so many samples of it; further ones start over
TOLERANCE = 0.05  # how far the scores let a limit be broken


@dataclass(frozen=True, slots=True)
class Noise:
    """Multiplies a true latency: exp(e), e ~ N(0, s) with s per machine, lognormal (median 0.015, sigma 0.95)."""

    factor: Floats

    @classmethod
    def of(cls, problem: Problem, kind: str, seed: int) -> "Noise":
        """`realistic` noise is seeded by the problem's id and `seed`; `none` is no noise."""
        n = len(problem.rows)
        if kind == "none":
            return cls(np.ones((REPEATS, n)))
        digest = hashlib.sha256(f"{seed}|{problem.id}".encode()).digest()
        random = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        sd = 0.015 * np.exp(0.95 * random.standard_normal(n))
        return cls(np.exp(sd * random.standard_normal((REPEATS, n))))


@dataclass
class Meter:
    """The only way to a machine's latency: paying for a sample."""

    truth_s: Floats
    price: Floats
    noise: Noise
    sampled: list[int] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)

    def sample(self, machine: int) -> float:
        """Measure once more; drawn anew and paid again."""
        again = self.sampled.count(machine) % len(self.noise.factor)
        latency = float(self.truth_s[machine] * self.noise.factor[again, machine])
        self.sampled.append(machine)
        self.latency_s.append(latency)
        return latency

    @property
    def paid(self) -> float:
        """Sum of the prices of all samples."""
        return float(self.price[self.sampled].sum())


@dataclass(frozen=True, slots=True)
class Run:
    """What a method ended with: its choice, predictions of log-latency and 90 % interval (N,), NaN where none."""

    chosen: int | None
    sampled: tuple[int, ...]
    paid: float
    log_latency: Floats
    low: Floats
    high: Floats
    probability_met: Floats


@dataclass(frozen=True)
class Case:
    """A problem with its machines, what is known of them elsewhere, and its noise; prepared once for all settings."""

    problem: Problem
    machines: Machines
    prior: Prior | None
    noise: Noise
    space: Space

    @classmethod
    def of(cls, problem: Problem, machines: Machines, prior: Prior | None, noise: Noise) -> "Case":
        """Prepares the model's space."""
        return cls(problem, machines, prior, noise, prepare(machines, prior))

    def meter(self) -> Meter:
        """A fresh meter: nothing sampled, nothing paid."""
        return Meter(self.problem.latency_s, self.machines.price_usd_per_hour, self.noise)

    def objective(self, setting: Setting) -> Objective:
        """The setting's objective over the machines."""
        return objective_of(self.problem, setting, self.machines.price_usd_per_hour, TOLERANCE)
