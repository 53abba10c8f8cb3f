"""The first batch of an adaptive campaign, and batches of instance types as offers, each where it is cheapest."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fogspec.base.units import dollars
from fogspec.catalog.instance_types import InstanceTypes, instance_types
from fogspec.catalog.table import Catalog, Floats
from fogspec.numerics.acquisition import Batch, cheapest


@dataclass(frozen=True, slots=True)
class NextBatch:
    """Offers to measure together, with a reason for each; none if sampling ends, and `reason` is why.

    Above the latency in `decided_above_s` a machine cannot become the choice; None where no latency decides.
    """

    rows: tuple[int, ...]
    reasons: tuple[str, ...]
    reason: str
    decided_above_s: tuple[float | None, ...] = ()

    def decided_above(self, number: int) -> float | None:
        """Return the latency in seconds above which the machine with this number is decided, rounded up to 3 digits."""
        above = self.decided_above_s[number] if self.decided_above_s else None
        if above is None:
            return None
        digit = 10.0 ** (math.floor(math.log10(above)) - 2)
        return float(f"{math.ceil(above / digit) * digit:.3g}")


@dataclass(frozen=True, slots=True)
class SampleCosts:
    """The maximum cost in USD of one sample of each of N types, and the row of the offer with that cost."""

    usd: Floats
    row: NDArray[np.intp]

    @classmethod
    def of(cls, types: InstanceTypes, usd_per_sample: Floats) -> "SampleCosts":
        """Return the costs by type from those of a sample of each offer (n,)."""
        order = np.lexsort((types.of, usd_per_sample))
        order = order[np.argsort(types.of[order], kind="stable")]
        row = order[np.searchsorted(types.of[order], np.arange(len(types)))]
        return cls(usd_per_sample[row], row)


def initial_batch(offers: Catalog, usd_per_sample: Floats, left_usd: float = np.inf) -> NextBatch:
    """Return the cheapest machines, before anything was measured."""
    costs = SampleCosts.of(instance_types(offers), usd_per_sample)
    batch = cheapest(costs.usd, left=left_usd)
    reasons = ["one of the cheapest, which are measured first"] * len(batch.machines)
    return next_batch(batch, costs, reasons, left_usd)


def next_batch(batch: Batch, costs: SampleCosts, reasons: Sequence[str], left_usd: float) -> NextBatch:
    """Return a batch of types as offers."""
    why = batch.reason
    if not batch.machines and left_usd < costs.usd.min(initial=np.inf):
        why = f"the cheapest sample may cost {dollars(float(costs.usd.min()))}, and {dollars(left_usd)} of the budget is left"
    return NextBatch(tuple(int(costs.row[one]) for one in batch.machines), tuple(reasons), why)
