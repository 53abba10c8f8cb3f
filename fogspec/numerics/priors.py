"""What other workloads do on the same machines, brought into the shape that the surrogate reads."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.surrogate import Prior

SHARE_KNOWN = 0.4  # a workload known on fewer of the machines in question says too little about them
RANK = 8
NEIGHBOURS = 4
FEWEST_WORKLOADS = 4


@dataclass(frozen=True)
class Library:
    """Log-latencies (W, M) of W workloads on M machines, NaN where not measured; suites group variants of a program."""

    names: tuple[str, ...]
    machines: Machines
    workloads: tuple[str, ...]
    suites: tuple[str, ...]
    log_latency: Floats
    digest: str = ""
    row: dict[str, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.log_latency.shape != (len(self.workloads), len(self.names)):
            raise ValueError("log_latency must be workloads x machines")
        object.__setattr__(self, "row", {name: i for i, name in enumerate(self.names)})


def prior_for(
    library: Library, names: Sequence[str], machines: Machines, leave_out: Collection[str] = ()
) -> Prior | None:
    """The library's profiles at the machines (`cloud/type`), suites in `leave_out` excluded; None if it knows too little.

    Machines that the library lacks borrow from their nearest kin in it, with a variance that says so; single
    missing cells are filled from the other workloads by a low-rank fit.
    """
    kept = [i for i, suite in enumerate(library.suites) if suite not in leave_out]
    if not kept:
        return None
    rows = np.array([library.row.get(name, -1) for name in names])
    known = library.log_latency[kept]
    profiles = np.where(rows >= 0, known[:, np.maximum(rows, 0)], np.nan)
    own = np.zeros(len(names))
    absent = np.flatnonzero(np.isnan(profiles).all(0))
    if len(absent) == len(names):
        own += 0.02
    there = _log_cores(library.machines), _log_cores(machines)
    for machine in absent:
        profiles[:, machine], own[machine] = _borrowed(library.machines, known, machines, int(machine), there)
    enough = np.isfinite(profiles).mean(1) >= SHARE_KNOWN
    if enough.sum() < FEWEST_WORKLOADS:
        return None
    suites = [library.suites[i] for i in np.array(kept)[enough]]
    weight = np.array([suites.count(suite) ** -0.5 for suite in suites])
    return Prior(_completed(profiles[enough]), weight / weight.sum(), own)


def _log_cores(machines: Machines) -> Floats:
    """Physical cores per vCPU, log2."""
    return np.asarray(np.log2(machines.cores / machines.vcpus))


def _borrowed(
    library: Machines, known: Floats, machines: Machines, at: int, cores: tuple[Floats, Floats]
) -> tuple[Floats, float]:
    """Profile of a machine from its nearest kin: same kind of CPU before same size before same memory."""
    distance = (
        4 * (np.log2(library.vcpus / machines.vcpus[at])) ** 2
        + 0.25 * np.log2(library.memory_gib / library.vcpus / machines.memory_gib[at] * machines.vcpus[at]) ** 2
        + 8 * (library.arch != machines.arch[at])
        + 2 * (library.cpu_model != machines.cpu_model[at])
        + 1 * (library.family != machines.family[at])
        + 1 * (library.cloud != machines.cloud[at])
        + 16 * (library.gpu != machines.gpu[at])
        + np.nan_to_num(4 * (cores[0] - cores[1][at]) ** 2)
    )
    distance = np.where(np.isfinite(known).any(0), distance, np.inf)
    nearest = np.argsort(distance, kind="stable")[:NEIGHBOURS]
    weight = np.exp(-(distance[nearest] - distance[nearest[0]]))[None, :] * np.isfinite(known[:, nearest])
    total = weight.sum(1)
    profile = (weight * np.nan_to_num(known[:, nearest])).sum(1) / np.where(total > 0, total, 1)
    return np.where(total > 0, profile, np.nan), float(0.005 + 0.01 * distance[nearest[0]])


def _completed(profiles: Floats) -> Floats:
    """Missing cells from the low-rank structure of the others (iterated singular value thresholding).

    Source: Mazumder, Hastie, Tibshirani, Spectral Regularization Algorithms, JMLR 11 (2010).
    """
    missing = np.isnan(profiles)
    level = np.nanmean(profiles, axis=1, keepdims=True)
    if not missing.any():
        return np.asarray(profiles - level)
    effect = np.nanmean(profiles - level, axis=0, keepdims=True)
    filled = np.where(missing, level + effect, profiles)
    for _ in range(12):
        level = filled.mean(1, keepdims=True)
        left, size, right = np.linalg.svd(filled - level, full_matrices=False)
        size = np.maximum(size - 0.05 * size[0], 0.0)[:RANK]
        filled = np.where(missing, (left[:, :RANK] * size) @ right[:RANK] + level, profiles)
    return np.asarray(filled - filled.mean(1, keepdims=True))
