"""Prior data: log-latencies of other workloads on the same machines, imputed and completed for the surrogate."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from fogspec.numerics.kernels import Floats, Machines
from fogspec.numerics.surrogate import Prior

MIN_COVERAGE = 0.4  # fraction of the machines on which a workload must be known to count
RANK = 8
NEIGHBOURS = 4
MIN_WORKLOADS = 4


@dataclass(frozen=True, kw_only=True)
class PriorData:
    """Log-latencies (W, M) of W workloads on M machines, NaN if not measured; suites group variants of a program.

    Raise ValueError if `log_latency` does not have that shape.
    """

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
    data: PriorData, names: Sequence[str], machines: Machines, leave_out: Collection[str] = ()
) -> Prior | None:
    """Return the profiles of the data at the machines (`cloud/type`) without the suites in `leave_out`; None if too few.

    Machines absent from the data are imputed from their nearest neighbours, with a nugget variance for the imputation;
    single missing cells are completed from the other workloads by a low-rank fit.
    """
    kept = [i for i, suite in enumerate(data.suites) if suite not in leave_out]
    if not kept:
        return None
    rows = np.array([data.row.get(name, -1) for name in names])
    known = data.log_latency[kept]
    profiles = np.where(rows >= 0, known[:, np.maximum(rows, 0)], np.nan)
    nugget = np.zeros(len(names))
    absent = np.flatnonzero(np.isnan(profiles).all(0))
    if len(absent) == len(names):
        nugget += 0.02
    there = _log_cores(data.machines), _log_cores(machines)
    for machine in absent:
        profiles[:, machine], nugget[machine] = _impute_from_neighbours(
            data.machines, known, machines, int(machine), there
        )
    enough = np.isfinite(profiles).mean(1) >= MIN_COVERAGE
    if enough.sum() < MIN_WORKLOADS:
        return None
    # A machine may be known by workloads alone that did not count.
    known, profiles = known[enough], profiles[enough]
    for machine in np.flatnonzero(np.isnan(profiles).all(0)):
        profiles[:, machine], nugget[machine] = _impute_from_neighbours(
            data.machines, known, machines, int(machine), there
        )
    suites = [data.suites[i] for i in np.array(kept)[enough]]
    weight = np.array([suites.count(suite) ** -0.5 for suite in suites])
    return Prior(_complete_matrix(profiles), weight / weight.sum(), nugget, tuple(suites))


def _log_cores(machines: Machines) -> Floats:
    """Return the physical cores per vCPU, log2, (N,)."""
    return np.asarray(np.log2(machines.cores / machines.vcpus))


def _impute_from_neighbours(
    known_machines: Machines, known: Floats, machines: Machines, at: int, cores: tuple[Floats, Floats]
) -> tuple[Floats, float]:
    """Return the imputed profile (W,) of a machine and its variance: kind of CPU counts before size, size before memory."""
    distance = (
        4 * (np.log2(known_machines.vcpus / machines.vcpus[at])) ** 2
        + 0.25
        * np.log2(known_machines.memory_gib / known_machines.vcpus / machines.memory_gib[at] * machines.vcpus[at]) ** 2
        + 8 * (known_machines.arch != machines.arch[at])
        + 2 * (known_machines.cpu_model != machines.cpu_model[at])
        + 1 * (known_machines.family != machines.family[at])
        + 1 * (known_machines.cloud != machines.cloud[at])
        + 16 * (known_machines.gpu != machines.gpu[at])
        + np.nan_to_num(4 * (cores[0] - cores[1][at]) ** 2)
    )
    distance = np.where(np.isfinite(known).any(0), distance, np.inf)
    nearest = np.argsort(distance, kind="stable")[:NEIGHBOURS]
    weight = np.exp(-(distance[nearest] - distance[nearest[0]]))[None, :] * np.isfinite(known[:, nearest])
    total = weight.sum(1)
    profile = (weight * np.nan_to_num(known[:, nearest])).sum(1) / np.where(total > 0, total, 1)
    return np.where(total > 0, profile, np.nan), float(0.005 + 0.01 * distance[nearest[0]])


def _complete_matrix(profiles: Floats) -> Floats:
    """Return the profiles centred by workload, with missing cells completed (iterated singular value thresholding).

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
        centred = filled - level
        # The singular values are the roots of the eigenvalues of a matrix that is small whatever the number of machines.
        values, left = np.linalg.eigh(centred @ centred.T)
        size, left = np.sqrt(np.maximum(values[: -RANK - 1 : -1], 1e-30)), left[:, : -RANK - 1 : -1]
        kept = np.maximum(size - 0.05 * size[0], 0.0) / size
        filled = np.where(missing, (left * kept) @ (left.T @ centred) + level, profiles)
    return np.asarray(filled - filled.mean(1, keepdims=True))
