"""Shapes of this host, for `infra: [local]`: CPUs and memory that the local backend can limit a job to, without a price."""

import platform
from collections.abc import Sequence
from dataclasses import replace

from fogspec.base import digest, host
from fogspec.base.clouds import LOCAL
from fogspec.catalog.machine import Machine, host_shape
from fogspec.catalog.sources.parse import arch_of
from fogspec.catalog.table import About, Catalog, concatenated, of_machine, strings


def shapes_of(cpus: int, memory_gib: float) -> list[str]:
    """Return 1, 2, 4, ... and all CPUs of a host, each with its share of the memory, rounded down to a power of two in GiB.

    So a kernel that keeps a little more memory for itself changes nothing. A shape has 1 GiB at least.
    """
    counts = sorted({*(2**n for n in range(cpus.bit_length())), cpus})
    shares = [max(1, int(memory_gib * count / cpus)) for count in counts]
    return [
        f"{LOCAL}/{count}cpu-{2 ** (share.bit_length() - 1)}gib" for count, share in zip(counts, shares, strict=True)
    ]


def load(named: Sequence[str]) -> Catalog:
    """Return the shapes that the spec names, which are the same on every host with its kind of CPU, else those of this host."""
    machines = _machines(named) or _machines(shapes_of(*host.capacity()))
    arch = arch_of(LOCAL, "", platform.machine())
    about = About("shapes of this host", "", "", digest.of_value([arch, [one.instance for one in machines]]))
    offers = concatenated([of_machine(one) for one in machines], about)
    return replace(offers, arch=strings([arch] * len(offers))).in_order()


def _machines(names: Sequence[str]) -> list[Machine]:
    return [machine for name in dict.fromkeys(names) if (machine := host_shape(name)) is not None]
