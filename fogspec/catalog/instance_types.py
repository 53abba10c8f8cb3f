"""Instance types: the offers of a catalog without place and price kind, as the models read them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.table import Catalog, Strings, ranks
from fogspec.numerics.features import Machines, codes

Key = tuple[str, str, str, float]


@dataclass(frozen=True, slots=True)
class Shape:
    """A machine that was measured: its cloud and instance type, and what is known of it without a catalog."""

    cloud: str
    instance: str
    vcpus: float
    memory_gib: float
    gpu: str = ""
    gpu_count: float = 0.0

    @property
    def key(self) -> Key:
        """What makes it one type."""
        return self.cloud, self.instance, self.gpu, self.gpu_count


@dataclass(frozen=True, slots=True)
class InstanceTypes:
    """N types of n offers: `of` (n,) is each offer's type, `offer` (N,) the cheapest offer of each.

    Types are in the order of cloud, instance and accelerators, whatever the order of the offers.
    """

    keys: tuple[Key, ...]
    machines: Machines
    of: NDArray[np.intp]
    offer: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def names(self) -> list[str]:
        """`cloud/instance` of each, as machine libraries have them."""
        return [f"{cloud}/{instance}" for cloud, instance, _, _ in self.keys]


def instance_types(offers: Catalog) -> InstanceTypes:
    """The types of these offers."""
    key = np.zeros(len(offers), dtype=np.int64)
    for column in (offers.cloud, offers.instance, offers.gpu, offers.gpu_count):
        rank = ranks(column)
        key = key * (int(rank.max(initial=0)) + 1) + rank
    distinct, of = np.unique(key, return_inverse=True)
    order = np.lexsort((offers.spot, offers.price_usd_per_hour, of))
    cheapest = order[np.searchsorted(of[order], np.arange(len(distinct)))]
    rows = offers.take(cheapest)
    columns = (rows.cloud.tolist(), rows.instance.tolist(), rows.gpu.tolist(), rows.gpu_count.tolist())
    return InstanceTypes(tuple(zip(*columns, strict=True)), machines_of(rows), of.astype(np.intp), cheapest)


def machines_of(offers: Catalog) -> Machines:
    """The offers as the models read them; what a catalog does not say is unknown.

    Catalogs do not name the CPU. Machines of one cloud, architecture, clock rate and number of vCPUs a core mostly have
    the same one: on the development set that is nearly as good as its name, and much better than nothing.
    """
    about = zip(
        offers.cloud.tolist(), offers.arch.tolist(), offers.clock_ghz.tolist(),
        (offers.vcpus / offers.physical_cores).tolist(), strict=True,
    )  # fmt: skip
    cpu = [f"{cloud} {arch} {ghz:g} {smt:g}" if ghz == ghz else "" for cloud, arch, ghz, smt in about]
    return Machines(
        vcpus=offers.vcpus, memory_gib=offers.memory_gib, price_usd_per_hour=offers.price_usd_per_hour,
        family=_codes(offers.family), arch=_codes(offers.arch), cloud=_codes(offers.cloud),
        cpu_model=codes(cpu), gpu=_codes(offers.gpu), gpu_count=offers.gpu_count,
        gpu_memory_gib=offers.gpu_memory_gib, physical_cores=offers.physical_cores, clock_ghz=offers.clock_ghz,
        burstable=offers.burstable,
    )  # fmt: skip


def with_measured(offers: Catalog, measured: Sequence[Shape], catalog: Catalog | None = None) -> Catalog:
    """The offers, and after them a row for each measured machine that is not among them.

    What `catalog` says of it is taken from there; without it, family, architecture and the rest are unknown. Its price
    is of no account, for it cannot be chosen.
    """
    there = set(zip(offers.cloud, offers.instance, offers.gpu, offers.gpu_count, strict=True))
    missing = {shape.key: shape for shape in measured if shape.key not in there}
    if not missing:
        return offers
    rows = [_row(shape, offers, catalog) for _, shape in sorted(missing.items())]
    columns = [f.name for f in fields(Catalog) if f.name != "about"]
    joined = {name: np.concatenate([getattr(one, name) for one in (offers, *rows)]) for name in columns}
    return Catalog(about=offers.about, **joined)


def _row(shape: Shape, offers: Catalog, catalog: Catalog | None) -> Catalog:
    if catalog is not None:
        same = (catalog.instance == shape.instance) & (catalog.cloud == shape.cloud) & (catalog.gpu == shape.gpu)
        found = np.flatnonzero(same & (catalog.gpu_count == shape.gpu_count))
        if len(found):
            return catalog.take(found[:1])
    unknown = np.array([np.nan])
    return replace(
        offers.take(np.array([0])), cloud=_text(shape.cloud), instance=_text(shape.instance), gpu=_text(shape.gpu),
        gpu_count=np.array([shape.gpu_count]), vcpus=np.array([shape.vcpus]), memory_gib=np.array([shape.memory_gib]),
        region=_text(""), zone=_text(""), arch=_text(""), family=_text(""), gpu_memory_gib=unknown,
        physical_cores=unknown, clock_ghz=unknown, burstable=np.array([False]), spot=np.array([False]),
    )  # fmt: skip


def _text(word: str) -> Strings:
    return np.array([word], dtype=np.object_)


def _codes(column: Strings) -> NDArray[np.int64]:
    return codes([str(word) for word in column])
