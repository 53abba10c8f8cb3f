"""A suite: machines, their true latencies under workloads, and selection problems over them."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from fogspec.model.tables import Table
from fogspec.numerics.acquisition import Objective, busy, provisioned
from fogspec.numerics.features import Floats

KINDS = ("family", "catalog", "multicloud", "gpu")


@dataclass(frozen=True, slots=True)
class Setting:
    """One question about a problem: the weight of latency and the limits, None where there is none.

    With a rate of requests whole hours are paid for (provisioned billing), without one busy seconds. `confidence` is the
    probability with which the limits must be met.
    """

    name: str
    alpha: float
    max_latency_s: float | None
    max_cost_usd_per_request: float | None
    requests_per_second: float | None = None
    confidence: float = 0.9


@dataclass(frozen=True, slots=True)
class Problem:
    """Choose among machines (rows of the suite's table) for a workload; scales are the objective's denominators."""

    id: str
    kind: str
    workload: str
    suite: str
    rows: np.ndarray
    latency_s: Floats
    scale_latency_s: float
    scale_cost_usd: float
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class Suite:
    """Machines and problems."""

    table: Table
    problems: tuple[Problem, ...]


def objective_of(problem: Problem, setting: Setting, price: Floats, tolerance: float) -> Objective:
    """The setting as an objective over the problem's machines, priced in USD per hour (N,)."""
    rate = setting.requests_per_second
    kind = busy if rate is None else partial(provisioned, requests_per_second=rate)
    return kind(
        price,
        alpha=setting.alpha,
        scale_latency_s=problem.scale_latency_s,
        scale_cost_usd=problem.scale_cost_usd,
        max_latency_s=setting.max_latency_s,
        max_cost_usd=setting.max_cost_usd_per_request,
        confidence=setting.confidence,
        tolerance=tolerance,
    )
