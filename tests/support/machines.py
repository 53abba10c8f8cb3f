"""Machines to choose among, made by rule."""

from dataclasses import replace

import numpy as np

from fogspec.catalog.cost import Costs
from fogspec.choice.rule import Rule, Selection
from fogspec.model.predict import Predictions
from fogspec.numerics.kernels import Floats, Machines, codes
from fogspec.numerics.surrogate import Posterior

FAMILIES = ("c6i", "m6i", "r6i")
SIZES = np.array([2.0, 4, 8, 16, 32, 48, 64])


def family() -> Machines:
    """One generation: seven sizes with 2, 4 and 8 GiB per vCPU, prices in proportion."""
    vcpus = np.tile(SIZES, 3)
    per_cpu = np.repeat([2.0, 4.0, 8.0], len(SIZES))
    n, unknown = len(vcpus), np.full(len(vcpus), np.nan)
    return Machines(
        vcpus=vcpus, memory_gib=vcpus * per_cpu, price_usd_per_hour=vcpus * (0.0425 + 0.0014 * (per_cpu - 2)),
        family=codes([name for name in FAMILIES for _ in SIZES]), arch=codes(["x86_64"] * n), cloud=codes(["aws"] * n),
        cpu_model=codes(["8375C"] * n), gpu=codes([""] * n), gpu_count=np.zeros(n), gpu_memory_gib=unknown,
        physical_cores=vcpus / 2, clock_ghz=np.full(n, 3.5), burstable=np.zeros(n, dtype=bool),
    )  # fmt: skip


def rule_over(machines: Machines, *, requests_per_s: float | None = None, **more: object) -> Rule:
    """A rule without limits over machines, with a confidence of 0.9; `more` are fields of `Rule`."""
    price = machines.price_usd_per_hour
    costs = replace(Costs.busy(price), requests_per_s=requests_per_s)
    names = np.array([f"m{i}" for i in range(len(price))], dtype=object)
    return Rule(**{"costs": costs, "names": names, "alpha": 0.5, "confidence": 0.9, "measured_first": True} | more)


def selected(posterior: Posterior, rule: Rule) -> Selection:
    """The rule applied to a posterior."""
    return Selection(rule=rule, latency=Predictions.of_posterior(posterior))


def amdahl(machines: Machines, serial: float, seconds: float = 10.0) -> Floats:
    """Latency of a program of which a share is serial."""
    return seconds * (serial + (1 - serial) / machines.vcpus)
