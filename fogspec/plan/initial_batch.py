"""Which machines to measure next: the acquisition rule over offers, an instance type asked for where it is cheapest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.instance_types import InstanceTypes, instance_types
from fogspec.catalog.table import Catalog, Floats
from fogspec.numerics.acquisition import Wave, initial_wave
from fogspec.numerics.priors import Library, prior_for
from fogspec.numerics.samples import observations
from fogspec.numerics.surrogate import prepare


@dataclass(frozen=True, slots=True)
class NextBatch:
    """Offers to measure at once, with a reason for each; none when sampling ends, and `reason` says why."""

    rows: tuple[int, ...]
    reasons: tuple[str, ...]
    reason: str


@dataclass(frozen=True, slots=True)
class SampleCosts:
    """What one sample of each of N types costs at most, in USD, and the offer where it costs so little."""

    usd: Floats
    row: NDArray[np.intp]

    @classmethod
    def of(cls, types: InstanceTypes, usd_per_sample: Floats) -> "SampleCosts":
        """From what a sample of each offer (n,) costs."""
        order = np.lexsort((types.of, usd_per_sample))
        order = order[np.argsort(types.of[order], kind="stable")]
        row = order[np.searchsorted(types.of[order], np.arange(len(types)))]
        return cls(usd_per_sample[row], row)


def initial_batch(
    offers: Catalog, usd_per_sample: Floats, left_usd: float = np.inf, library: Library | None = None
) -> NextBatch:
    """The machines that together say most about all offers for their price, before anything was measured."""
    types = instance_types(offers)
    bill = SampleCosts.of(types, usd_per_sample)
    prior = None if library is None else prior_for(library, types.names, types.machines)
    posterior = prepare(types.machines, prior).fit(observations([], []))
    wave = initial_wave(posterior, sample_cost=bill.usd, left=left_usd)
    reasons = ["one of the first: together they say most about all machines for their price"] * len(wave.machines)
    return next_batch(wave, bill, reasons, left_usd)


def next_batch(wave: Wave, bill: SampleCosts, reasons: Sequence[str], left_usd: float) -> NextBatch:
    """A wave of types as offers."""
    why = wave.reason
    if not wave.machines and left_usd < bill.usd.min(initial=np.inf):
        why = f"the cheapest sample may cost ${bill.usd.min():.4g}, and ${left_usd:.4g} of the budget is left"
    return NextBatch(tuple(int(bill.row[one]) for one in wave.machines), tuple(reasons), why)
