"""A first machine before any measurement: the robot's own latency, carried over by what other workloads show.

Each workload of a machine library says how many times as fast a machine is as the robot, whose own speed is that of the
library's machines most like it (`fogspec.numerics.priors`). Workloads differ, and so the guess has an interval. It replaces
no sample.
"""

import math
from dataclasses import dataclass

import numpy as np

from fogspec.base.units import rounded, shown_duration, shown_interval, shown_price
from fogspec.catalog.cost import Costs
from fogspec.catalog.filters import offers_for
from fogspec.catalog.instance_types import instance_types
from fogspec.catalog.table import Catalog
from fogspec.language.schema import Spec
from fogspec.numerics.kernels import Floats, Machines, codes
from fogspec.numerics.priors import PriorData, prior_for

Z90 = 1.644854  # two-sided 90% quantile of the standard normal distribution


@dataclass(frozen=True, kw_only=True)
class Robot:
    """The computer that the nodes run on now, and one request there: seconds, and memory in GiB that the node used."""

    vcpus: float
    memory_gib: float
    arch: str
    cpu: str
    latency_s: float
    used_gib: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Guess:
    """A machine and its expected latency in seconds, with a 90% interval; `meets`: whether that meets the limit."""

    instance: str
    infra: str
    usd_per_hour: float
    latency_s: float
    interval_s: tuple[float, float]
    workloads: int
    meets: bool

    def line(self) -> str:
        """Return it as a line of text."""
        low, high = (rounded(value, 2) for value in self.interval_s)
        found = f"{self.instance} in {self.infra}, {shown_price(self.usd_per_hour)}"
        expected = f"{shown_duration(rounded(self.latency_s, 2))}{shown_interval((low, high))}"
        reason = (
            "the cheapest per request that meets the limit"
            if self.meets
            else "the fastest: none is expected to meet the limit"
        )
        return f"first guess: {found}: {expected} by {self.workloads} other workloads; {reason}. Measuring decides"


def first_guess(library: PriorData, spec: Spec, robot: Robot, catalog: Catalog) -> Guess | None:
    """Return a machine on offer; None if the library or the catalog says too little of the admissible machines."""
    offers = offers_for(catalog, spec).offers
    offers = offers.take((offers.memory_gib >= robot.used_gib) & ~offers.spot)
    if not len(offers):
        return None
    types = instance_types(offers)
    prior = prior_for(library, [*types.names, ""], _with(types.machines, robot))
    if prior is None:
        return None
    faster = prior.profiles[:, :-1] - prior.profiles[:, -1:]
    mean = prior.weight @ faster
    variance = prior.weight @ (faster - mean) ** 2 + prior.nugget[:-1] + prior.nugget[-1]
    latency_s = robot.latency_s * np.exp(mean)
    rows = offers.take(types.offer)
    limit = spec.constraints.latency
    within = latency_s <= (math.inf if limit is None else limit - spec.constraints.network_allowance)
    cost = Costs.of(spec, rows.paid_usd_per_hour, rows.spot).per_request(latency_s)
    score: Floats = np.where(within, cost, np.inf) if within.any() else latency_s
    best = int(np.argmin(score))
    width = math.exp(Z90 * math.sqrt(variance[best]))
    return Guess(
        instance=str(rows.instance[best]),
        infra=rows.infra(best),
        usd_per_hour=float(rows.price_usd_per_hour[best]),
        latency_s=float(latency_s[best]),
        interval_s=(float(latency_s[best] / width), float(latency_s[best] * width)),
        workloads=len(prior.weight),
        meets=bool(within.any()),
    )


def _with(machines: Machines, robot: Robot) -> Machines:
    """Return the machines with the robot as the last one; what is not known of it is unknown."""
    own = {
        "vcpus": robot.vcpus, "memory_gib": robot.memory_gib, "price_usd_per_hour": 1.0, "family": -1, "cloud": -1, "gpu": -1,
        "arch": codes([robot.arch])[0], "cpu_model": codes([robot.cpu])[0], "gpu_count": 0.0, "gpu_memory_gib": np.nan,
        "physical_cores": np.nan, "clock_ghz": np.nan, "burstable": False,
    }  # fmt: skip
    return Machines(**{name: np.append(getattr(machines, name), value) for name, value in own.items()})
