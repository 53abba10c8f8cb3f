"""The grid of models that is averaged over: mean curves, covariance components and their amplitudes."""

from dataclasses import dataclass
from itertools import product
from typing import Protocol

import numpy as np

from fogspec.numerics.kernels import Floats, Machines, interacted, matern, same, spread, stacked

LEVEL_VARIANCE = 25.0  # the level is unknown: e^5 either way at one standard deviation
SERIAL = (0.0, 0.03, 0.1, 0.3, 0.6, 1.0)
CONTENTION = (0.0, 0.001, 0.004, 0.02)
# Over many kinds of CPU no model of the grid is right, and the samples, cheap machines mostly, cannot say by how much:
# held-out machines' errors were 1.4 to 1.9 times as wide as stated.
WIDENED = 1.7**2
MOST_FEW = 6  # kinds of CPU, or families: two generations of c, m and r


class HasProfiles(Protocol):
    """What the grid needs of a prior."""

    @property
    def profiles(self) -> Floats: ...  # noqa: D102
    @property
    def weight(self) -> Floats: ...  # noqa: D102
    @property
    def own(self) -> Floats: ...  # noqa: D102


@dataclass(frozen=True)
class Grid:
    """H models over N machines: model h has mean `curves[curve[h]]` and covariance sum_j theta[h, j] F_j F_j'.

    `own` (H, N) is the variance of what each machine has to itself. The variance of machines
    that were not measured is multiplied by `widened`.
    """

    features: list[Floats]
    curves: Floats
    curve: np.ndarray
    theta: Floats
    own: Floats
    widened: float = 1.0

    @property
    def diagonal(self) -> Floats:
        """Variance of each component at each machine (J, N) at amplitude 1."""
        return np.array([(f**2).sum(1) for f in self.features])


def scaling_curves(machines: Machines) -> Floats:
    """Amdahl's law with linear contention, log((1-s)/n + s + k(n-1)), a row for each curve.

    n is vCPUs over the smallest vCPU count. Machines with a GPU follow the curve of one vCPU: what their CPUs do
    for them is left to the covariance.
    """
    n = np.where(machines.gpu >= 0, 1.0, machines.vcpus / machines.vcpus.min())
    return np.array([np.log((1 - s) / n + s + k * (n - 1)) for s, k in product(SERIAL, CONTENTION)])


def hardware(machines: Machines) -> list[Floats]:
    """Components: level, size and memory (smooth), kind of CPU, kind of CPU x size, GPU."""
    size = np.log2(machines.vcpus)
    per_cpu = np.log2(machines.memory_gib / machines.vcpus)
    scaled = (size - size.mean()) / 3
    smt = np.log2(machines.vcpus / machines.cores)
    kinds = stacked(
        same(machines.cpu_model), 0.7 * same(machines.arch), 0.5 * same(machines.cloud), 0.5 * same(machines.family),
        0.5 * smt, 0.5 * spread(np.log(machines.clock_ghz)), 0.5 * machines.burstable.astype(float),
    )  # fmt: skip
    has_gpu = (machines.gpu >= 0).astype(float)
    count = np.log2(np.maximum(machines.gpu_count, 1)) * has_gpu
    memory = spread(np.log(np.where(machines.gpu_memory_gib > 0, machines.gpu_memory_gib, np.nan))) * has_gpu
    gpu = stacked(2 * has_gpu, same(machines.gpu), 0.5 * count, 0.5 * memory, interacted(has_gpu[:, None], scaled))
    return [
        np.ones((len(machines), 1)),
        matern(np.column_stack([size, per_cpu]), np.array([2.0, 2.0])),
        kinds,
        interacted(kinds, scaled),
        gpu,
    ]


@dataclass(frozen=True, slots=True)
class Amplitudes:
    """Standard deviations, in log-latency, that are tried for each component; all pairings are averaged over."""

    smooth: tuple[float, ...]
    kind: tuple[float, ...]
    kind_by_size: float  # relative to `kind`
    own: tuple[float, ...]
    gpu: float
    library: tuple[float, ...] = ()


LIBRARY = (0.5, 1.0, 2.0, 4.0)
# Without a library and with one; the more there is to be wrong about the wider.
AMPLITUDES = {
    "one": (
        Amplitudes((0.03, 0.1, 0.25), (0.02,), 0.5, (0.01, 0.04), 0.0),
        Amplitudes((0.03, 0.1, 0.3), (0.02,), 0.5, (0.01, 0.04), 0.0, LIBRARY),
    ),
    "few": (
        Amplitudes((0.03, 0.1, 0.25), (0.02, 0.1, 0.4), 0.5, (0.01, 0.04), 0.0),
        Amplitudes((0.01, 0.05, 0.15), (0.01, 0.05, 0.15), 0.5, (0.01, 0.04), 0.0, LIBRARY),
    ),
    "many": (
        Amplitudes((0.1, 0.3), (0.1, 0.4), 0.7, (0.03, 0.12), 0.0),
        Amplitudes((0.1, 0.3, 0.8), (0.1, 0.3), 0.7, (0.03, 0.12), 0.0, LIBRARY),
    ),
    "gpus": (
        Amplitudes((0.1, 0.3, 1.0), (0.3, 1.0), 1.0, (0.03, 0.15), 2.0),
        Amplitudes((0.1, 0.3, 1.0), (0.2, 0.6), 0.5, (0.05, 0.2), 2.0, LIBRARY),
    ),
}


def variety(machines: Machines) -> str:
    """How different the machines are: "one" kind of CPU, a "few" within a generation, "many", "gpus" among them."""
    if (machines.gpu >= 0).any():
        return "gpus"
    models, families = len(np.unique(machines.cpu_model)), len(np.unique(machines.family))
    if models > MOST_FEW or families > MOST_FEW:
        return "many"
    return "few" if models > 1 or families > 3 else "one"


def grid_without_prior(machines: Machines) -> Grid:
    """Scaling curves x amplitudes of the residual."""
    tried = AMPLITUDES[variety(machines)][0]
    return _grid(machines, hardware(machines), scaling_curves(machines), tried, 0.0)


def grid_with_prior(machines: Machines, prior: HasProfiles) -> Grid:
    """The library's mean profile and covariance, plus hardware components for what the library does not know."""
    weight = prior.weight / prior.weight.sum()
    centred = prior.profiles - prior.profiles.mean(1, keepdims=True)
    mean = weight @ centred
    library = (np.sqrt(weight)[:, None] * (centred - mean)).T
    tried = AMPLITUDES[variety(machines)][1]
    return _grid(machines, [*hardware(machines), library], mean[None, :], tried, prior.own)


def _grid(machines: Machines, features: list[Floats], curves: Floats, tried: Amplitudes, own: Floats | float) -> Grid:
    weights: list[tuple[float, ...]] = [(one,) for one in tried.library] or [()]
    rows = [
        (curve, (LEVEL_VARIANCE, smooth**2, kind**2, (kind * tried.kind_by_size) ** 2, tried.gpu**2, *amplitude), alone)
        for curve in range(len(curves)) for amplitude in weights
        for smooth in tried.smooth for kind in tried.kind for alone in tried.own
    ]  # fmt: skip
    alone = np.array([row[2] for row in rows])
    return Grid(
        features=features,
        curves=curves - curves.mean(1, keepdims=True),
        curve=np.array([row[0] for row in rows]),
        theta=np.array([row[1] for row in rows]),
        own=np.repeat(alone[:, None] ** 2, len(machines), axis=1) + own,
        widened=WIDENED if variety(machines) in ("many", "gpus") else 1.0,
    )
