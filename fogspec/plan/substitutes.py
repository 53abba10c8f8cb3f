"""Substitutes for unavailable machines: the same machine in another place, or the nearest admissible machine."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fogspec.base.clouds import split_infra
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog, Floats
from fogspec.plan.design import cheapest_first
from fogspec.plan.schema import Sample, Substitute, replicate, sample_on
from fogspec.spec.schema import Spec

PLACES = 2
NEIGHBOURS = 2
DOUBLINGS = 2.0  # a machine that differs more in vCPUs and memory together is not a neighbour


def substitutes(spec: Spec, samples: Sequence[Sample], offers: Catalog) -> list[Substitute]:
    """Return the substitutes of each sample in the order in which they are tried; `offers` are the admissible machines.

    First the same instance type elsewhere, cheapest first; then the machines nearest in vCPUs and memory with the same
    accelerators, in the same place if there are any. Machines that the spec lists by name have no neighbours; shapes
    of this host and further samples of a machine have no substitutes. One machine may be the substitute of several
    samples; a machine of the plan itself is not a substitute.
    """
    planned = {sample.id for sample in samples}
    found = []
    shapes = np.log2(offers.vcpus), np.log2(offers.memory_gib)
    for sample in samples:
        machine = sample.machine
        if machine.is_local or replicate(sample.id) > 1:
            continue
        apart = np.abs(shapes[0] - np.log2(machine.cpus)) + np.abs(shapes[1] - np.log2(machine.memory))
        near = _Near.of(offers, machine, apart)
        elsewhere = list(near.elsewhere())[:PLACES]
        neighbours = () if spec.benchmark.machines else near.neighbours()
        others = [*elsewhere, *(one for one in neighbours if one.id not in planned)][: len(elsewhere) + NEIGHBOURS]
        found += [Substitute(substitute_for=sample.id, machine=one.machine, reason=one.reason) for one in others]
    return found


def other_region(one: Machine, two: Machine) -> bool:
    """Return whether two machines are in different regions, which have separate quotas."""
    return split_infra(one.infra)[:2] != split_infra(two.infra)[:2]


@dataclass(frozen=True, slots=True)
class _Near:
    """Offers near a machine, with the same accelerators and kind of price; `apart` is their distance in doublings."""

    machine: Machine
    offers: Catalog
    apart: Floats
    infra: list[str]

    @classmethod
    def of(cls, offers: Catalog, machine: Machine, apart: Floats) -> "_Near":
        same = (apart <= DOUBLINGS) & (offers.spot == machine.spot)
        same[same] = offers.take(same).carries(machine)
        near = offers.take(same)
        return cls(machine, near, np.round(apart[same], 6), [near.infra(row) for row in range(len(near))])

    def elsewhere(self) -> Iterator[Sample]:
        """Yield the same instance type in other places, cheapest first."""
        same = np.flatnonzero(self.offers.instance == self.machine.instance)
        for row in same[cheapest_first(self.offers.take(same))].tolist():
            if self.infra[row] != self.machine.infra:
                yield self._sample(row, "the same instance type in another place")

    def neighbours(self) -> Iterator[Sample]:
        """Yield other instance types, in the same place if there are any, by distance and difference in price."""
        names, price = self.offers.instance.tolist(), self.offers.price_usd_per_hour
        other = [row for row, name in enumerate(names) if name != self.machine.instance]
        here = [row for row in other if self.infra[row] == self.machine.infra]
        price_gap = np.round(np.abs(np.log2(price / max(self.machine.price, 1e-9))), 6)
        known: set[str] = set()
        for row in sorted(here or other, key=lambda row: (self.apart[row], price_gap[row], names[row], row)):
            if names[row] not in known:
                known.add(names[row])
                yield self._sample(row, f"the nearest admissible machine to {self.machine.instance}")

    def _sample(self, row: int, reason: str) -> Sample:
        return sample_on(self.offers.machine(row), reason)
