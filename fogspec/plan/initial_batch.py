"""The initial design of an adaptive campaign, and batches of instance types as offers, each where it is cheapest."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fogspec.base.units import dollars
from fogspec.catalog.instance_types import InstanceTypes, instance_types
from fogspec.catalog.table import Catalog, Floats
from fogspec.numerics.acquisition import Batch, Policy, initial_design
from fogspec.numerics.nested import Parts
from fogspec.numerics.observations import observations
from fogspec.numerics.priors import PriorData, prior_for
from fogspec.numerics.surrogate import prepare
from fogspec.plan.commitment import PART_S, Commitment
from fogspec.spec.schema import Benchmark

MOST_EXPECTED = 20  # samples of a campaign; of few instance types half as many as there are


@dataclass(frozen=True, slots=True)
class NextBatch:
    """Offers to measure together, with a reason for each; none if sampling ends, and `reason` is why.

    `parts` of each are the rows of the offers that parts of its machine stand for, to be measured with it. Above the latency in
    `decided_above_s` a machine cannot become the choice; None where no latency decides.
    """

    rows: tuple[int, ...]
    reasons: tuple[str, ...]
    reason: str
    parts: tuple[tuple[int, ...], ...] = ()
    decided_above_s: tuple[float | None, ...] = ()

    def part_types(self, offers: Catalog, number: int) -> set[str]:
        """Return the instance types that parts of the machine with this number in the batch stand for."""
        return {str(offers.instance[row]) for row in self.parts[number]} if self.parts else set()

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


def batch_size(benchmark: Benchmark, types: int, *, batches: int = 0, samples: int = 0) -> int:
    """Return how many machines to measure at once after these batches and samples; 0 if the wall time is used up.

    A wall time is shared out among the batches that it has room for, each at its longest, so that as many samples are
    possible as campaigns over this many instance types need.
    """
    first = Policy().first if benchmark.volume is None else 1
    usual = (benchmark.batch_size or 1) if batches else first
    if benchmark.wall_time is None:
        return usual
    room = math.floor(benchmark.wall_time / Commitment.of(benchmark).wall_s + 1e-9) - batches
    if room <= 0:
        return 0
    if batches and benchmark.batch_size is not None:
        return usual
    return max(usual, math.ceil((min(MOST_EXPECTED, math.ceil(types / 2)) - samples) / room))


def initial_batch(
    offers: Catalog,
    usd_per_sample: Floats,
    left_usd: float = np.inf,
    library: PriorData | None = None,
    benchmark: Benchmark | None = None,
) -> NextBatch:
    """Return the machines that together tell most about all offers for their price, before anything was measured."""
    types = instance_types(offers)
    costs = SampleCosts.of(types, usd_per_sample)
    prior = None if library is None else prior_for(library, types.names, types.machines)
    posterior = prepare(types.machines, prior).fit(observations([], []))
    count = None if benchmark is None else batch_size(benchmark, len(types))
    nested = None if benchmark is None else parts_of(benchmark, types)
    batch = initial_design(posterior, sample_cost=costs.usd, left=left_usd, count=count, nested=nested)
    reasons = ["one of the first: together they say most about all machines for their price"] * len(batch.machines)
    return next_batch(batch, costs, reasons, left_usd)


def next_batch(batch: Batch, costs: SampleCosts, reasons: Sequence[str], left_usd: float) -> NextBatch:
    """Return a batch of types as offers."""
    why = batch.reason
    if not batch.machines and left_usd < costs.usd.min(initial=np.inf):
        why = f"the cheapest sample may cost {dollars(float(costs.usd.min()))}, and {dollars(left_usd)} of the budget is left"
    parts = tuple(tuple(int(costs.row[one]) for one in some) for some in batch.parts)
    return NextBatch(tuple(int(costs.row[one]) for one in batch.machines), tuple(reasons), why, parts)


def parts_of(benchmark: Benchmark, types: InstanceTypes) -> Parts | None:
    """Return the parts of these types and what one adds to the price of a sample; None if only machines are measured."""
    if benchmark.shapes == "own":
        return None
    each = Commitment.of(benchmark)
    return Parts.of(types.machines, PART_S / (each.paid_s - each.parts_s))
