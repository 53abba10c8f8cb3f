"""The ensemble of Gaussian process models: mean curves, covariance components and a grid of their amplitudes."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Protocol

import numpy as np

from fogspec.numerics.kernels import Floats, Machines, distinct, hstack, interaction, matern, one_hot, standardise

LEVEL_VARIANCE = 25.0  # of the unknown level: a factor of e^5 at one standard deviation
SERIAL = (0.0, 0.03, 0.1, 0.3, 0.6, 1.0)
CONTENTION = (0.0, 0.001, 0.004, 0.02)
# With GPUs every model is misspecified, and the samples, mostly of cheap machines, do not show by how much: errors on
# held-out machines were 1.4 to 1.9 times the predicted standard deviation. Amplitudes that are as wide as that cost more
# samples and cover less (ADR 0020).
INFLATION = 1.7**2
MAX_FEW = 6  # kinds of CPU, or families: two generations of c, m and r


class HasProfiles(Protocol):
    """The parts of a prior that the ensemble reads."""

    @property
    def profiles(self) -> Floats: ...  # noqa: D102
    @property
    def weight(self) -> Floats: ...  # noqa: D102
    @property
    def nugget(self) -> Floats: ...  # noqa: D102


@dataclass(frozen=True, kw_only=True)
class Ensemble:
    """H models over N machines: model h has mean `curves[curve[h]]` and covariance sum_j theta[h, j] F_j F_j'.

    `nugget` (H, N) is the idiosyncratic variance of each machine. The posterior variance of unmeasured machines is
    multiplied by `inflation`.
    """

    features: list[Floats]
    curves: Floats
    curve: np.ndarray
    theta: Floats
    nugget: Floats
    inflation: float = 1.0

    def amplitudes(self, weights: Floats) -> dict[str, float]:
        """Return the standard deviation of log-latency by component under the weights (H,) of the models, if it has any.

        `machine` is what a machine has of its own; the level, which no model knows, is left out.
        """
        names = ("size_and_memory", "kind", "kind_by_size", "gpu", "programs")
        found = dict(zip(names, np.sqrt(weights @ self.theta[:, 1:]).tolist(), strict=False))
        found["machine"] = float(np.sqrt(weights @ self.nugget.mean(1)))
        return {name: sd for name, sd in found.items() if sd > 0}

    @cached_property
    def diagonal(self) -> Floats:
        """Variance of each component at each machine at amplitude 1, (J, N)."""
        return np.array([(f**2).sum(1) for f in self.features])


def scaling_curves(machines: Machines) -> Floats:
    """Return Amdahl's law with linear contention, log((1-s)/n + s + k(n-1)), one row per curve.

    n is vCPUs over the smallest vCPU count. Machines with a GPU follow the curve of one vCPU; the covariance models the
    effect of their CPUs.
    """
    n = np.where(machines.gpu >= 0, 1.0, machines.vcpus / machines.vcpus.min())
    return np.array([np.log((1 - s) / n + s + k * (n - 1)) for s, k in product(SERIAL, CONTENTION)])


def hardware(machines: Machines) -> list[Floats]:
    """Return the components: level, size and memory (smooth), kind of CPU, kind of CPU x size, GPU."""
    size = np.log2(machines.vcpus)
    per_cpu = np.log2(machines.memory_gib / machines.vcpus)
    scaled = (size - size.mean()) / 3
    smt = np.log2(machines.vcpus / machines.cores)
    kinds = hstack(
        one_hot(machines.cpu_model),
        0.7 * one_hot(machines.arch),
        0.5 * one_hot(machines.cloud),
        0.5 * one_hot(machines.family),
        0.5 * smt,
        0.5 * standardise(np.log(machines.clock_ghz)),
        0.5 * machines.burstable.astype(float),
    )
    has_gpu = (machines.gpu >= 0).astype(float)
    count = np.log2(np.maximum(machines.gpu_count, 1)) * has_gpu
    memory = standardise(np.log(np.where(machines.gpu_memory_gib > 0, machines.gpu_memory_gib, np.nan))) * has_gpu
    gpu = hstack(2 * has_gpu, one_hot(machines.gpu), 0.5 * count, 0.5 * memory, interaction(has_gpu[:, None], scaled))
    return [
        np.ones((len(machines), 1)),
        matern(np.column_stack([size, per_cpu]), np.array([2.0, 2.0])),
        kinds,
        interaction(kinds, scaled),
        gpu,
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Amplitudes:
    """Standard deviations of log-latency to try for each component; the ensemble has all their combinations."""

    smooth: tuple[float, ...]
    kind: tuple[float, ...]
    kind_by_size: float  # relative to `kind`
    nugget: tuple[float, ...]
    gpu: tuple[float, ...]
    prior: tuple[float, ...] = ()


PRIOR = (0.5, 1.0, 2.0, 4.0)
# Without a prior and with one; the more heterogeneous the machines, the wider.
AMPLITUDES = {
    "one": (
        Amplitudes(smooth=(0.03, 0.1, 0.25), kind=(0.02,), kind_by_size=0.5, nugget=(0.01, 0.04), gpu=(0.0,)),
        Amplitudes(
            smooth=(0.03, 0.1, 0.3), kind=(0.02,), kind_by_size=0.5, nugget=(0.01, 0.04), gpu=(0.0,), prior=PRIOR
        ),
    ),
    "few": (
        Amplitudes(smooth=(0.03, 0.1, 0.25), kind=(0.02, 0.1, 0.4), kind_by_size=0.5, nugget=(0.01, 0.04), gpu=(0.0,)),
        Amplitudes(
            smooth=(0.01, 0.05, 0.15),
            kind=(0.01, 0.05, 0.15),
            kind_by_size=0.5,
            nugget=(0.01, 0.04),
            gpu=(0.0,),
            prior=PRIOR,
        ),
    ),
    "many": (
        Amplitudes(smooth=(0.17, 0.5), kind=(0.17, 0.7), kind_by_size=0.7, nugget=(0.05, 0.2), gpu=(0.0,)),
        Amplitudes(
            smooth=(0.17, 0.5, 1.4), kind=(0.17, 0.5), kind_by_size=0.7, nugget=(0.05, 0.2), gpu=(0.0,), prior=PRIOR
        ),
    ),
    "gpus": (
        Amplitudes(smooth=(0.1, 0.3, 1.0), kind=(0.3, 1.0), kind_by_size=1.0, nugget=(0.03, 0.15), gpu=(0.7, 2.0)),
        Amplitudes(
            smooth=(0.1, 0.3, 1.0), kind=(0.2, 0.6), kind_by_size=0.5, nugget=(0.05, 0.2), gpu=(2.0,), prior=PRIOR
        ),
    ),
}


def heterogeneity(machines: Machines) -> str:
    """Return the class of the machines: "one" kind of CPU, a "few" within a generation, "many", or "gpus" among them."""
    if (machines.gpu >= 0).any():
        return "gpus"
    models, families = len(distinct(machines.cpu_model)), len(distinct(machines.family))
    if models > MAX_FEW or families > MAX_FEW:
        return "many"
    return "few" if models > 1 or families > 3 else "one"


def ensemble_without_prior(machines: Machines) -> Ensemble:
    """Return the ensemble of scaling curves x amplitudes of the residual."""
    tried = AMPLITUDES[heterogeneity(machines)][0]
    return _ensemble(machines, hardware(machines), scaling_curves(machines), tried, 0.0)


def ensemble_with_prior(machines: Machines, prior: HasProfiles) -> Ensemble:
    """Return the ensemble with the prior's mean profile and covariance, plus hardware components for the residual."""
    weight = prior.weight / prior.weight.sum()
    centred = prior.profiles - prior.profiles.mean(1, keepdims=True)
    mean = weight @ centred
    profiles = (np.sqrt(weight)[:, None] * (centred - mean)).T
    tried = AMPLITUDES[heterogeneity(machines)][1]
    return _ensemble(machines, [*hardware(machines), profiles], mean[None, :], tried, prior.nugget)


def _ensemble(
    machines: Machines, features: list[Floats], curves: Floats, tried: Amplitudes, nugget: Floats | float
) -> Ensemble:
    weights: list[tuple[float, ...]] = [(one,) for one in tried.prior] or [()]
    rows = [
        (curve, (LEVEL_VARIANCE, smooth**2, kind**2, (kind * tried.kind_by_size) ** 2, gpu**2, *amplitude), alone)
        for curve in range(len(curves))
        for amplitude in weights
        for smooth in tried.smooth
        for kind in tried.kind
        for gpu in tried.gpu
        for alone in tried.nugget
    ]
    alone = np.array([row[2] for row in rows])
    return Ensemble(
        features=features,
        curves=curves - curves.mean(1, keepdims=True),
        curve=np.array([row[0] for row in rows]),
        theta=np.array([row[1] for row in rows]),
        nugget=np.broadcast_to(alone[:, None] ** 2, (len(rows), len(machines))) + nugget
        if isinstance(nugget, np.ndarray)
        else np.broadcast_to(alone[:, None] ** 2 + nugget, (len(rows), len(machines))),
        inflation=INFLATION if heterogeneity(machines) == "gpus" else 1.0,
    )
