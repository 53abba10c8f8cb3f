"""Instance types: the offers of a catalog without place and kind of price, as the models read them."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.classes import cpu_kind
from fogspec.catalog.machine import Machine, TypeKey
from fogspec.catalog.table import Catalog, Floats, Strings, ranks, row_ranks
from fogspec.numerics.kernels import Machines, codes


@dataclass(frozen=True, slots=True)
class InstanceTypes:
    """N types of n offers: `of` (n,) is each offer's type, `offer` (N,) the cheapest offer of each.

    Types are in the order of cloud, instance and accelerators, which are the `columns`, whatever the order of the offers.
    """

    columns: tuple[Strings, Strings, Strings, Floats]
    machines: Machines
    of: NDArray[np.intp]
    offer: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.offer)

    def __contains__(self, key: TypeKey) -> bool:
        row = self.place(key)
        return row < len(self) and self.key(row) == key

    def key(self, row: int) -> TypeKey:
        """Return the key of the type in a row."""
        cloud, instance, gpu, gpu_count = self.columns
        return cloud[row], instance[row], gpu[row], float(gpu_count[row])

    @property
    def keys(self) -> tuple[TypeKey, ...]:
        """The keys of all types, in their order."""
        return tuple(zip(*(column.tolist() for column in self.columns), strict=True))

    def place(self, key: TypeKey) -> int:
        """Return the row of a type, or before which it would be."""
        return bisect_left(range(len(self)), key, key=self.key)

    def row(self, key: TypeKey) -> int:
        """Return the row of a type; raise KeyError if it is not among these."""
        if key not in self:
            raise KeyError(key)
        return self.place(key)

    @property
    def names(self) -> list[str]:
        """Return `cloud/instance` of each, as in a machine library."""
        return [f"{cloud}/{instance}" for cloud, instance in zip(*self.columns[:2], strict=True)]


def instance_types(offers: Catalog) -> InstanceTypes:
    """Return the types of these offers."""
    of = row_ranks(offers.cloud, offers.instance, offers.gpu, offers.gpu_count)
    cheapest = _cheapest(of, offers)
    rows = offers.take(cheapest)
    return InstanceTypes((rows.cloud, rows.instance, rows.gpu, rows.gpu_count), machines_of(rows), of, cheapest)


def _cheapest(of: NDArray[np.intp], offers: Catalog) -> NDArray[np.intp]:
    """Return the offer (N,) of the lowest price of each type, on demand before spot, the first of equals."""
    least = np.full(int(of.max(initial=-1)) + 1, np.inf)
    np.minimum.at(least, of, offers.price_usd_per_hour)
    rows = np.flatnonzero(offers.price_usd_per_hour == least[of])
    rows = np.concatenate([rows[~offers.spot[rows]], rows[offers.spot[rows]]])
    found = np.empty(len(least), dtype=np.intp)
    found[of[rows[::-1]]] = rows[::-1]  # of several, the last one written stays
    return found


def clocked(offers: Catalog) -> frozenset[str]:
    """Return the clouds of which the catalog has the clock rate of any machine."""
    return frozenset(offers.cloud[~np.isnan(offers.clock_ghz)].tolist())


def machines_of(offers: Catalog, known_clouds: frozenset[str] | None = None) -> Machines:
    """Return the offers as the models read them; values that the catalog lacks are unknown.

    Catalogs do not name the CPU. Machines of one cloud, architecture, clock rate and number of vCPUs per core mostly
    have the same one: on the development set that is nearly as good as its name, and much better than no CPU at all.
    Of a cloud without any clock rate, as in SkyPilot's lists, the name of the family tells the CPU (ADR 0020);
    `known_clouds` are those that have one, of the offers if it is None.
    """
    known_clouds = clocked(offers) if known_clouds is None else known_clouds
    about = (
        offers.cloud,
        offers.arch,
        offers.family,
        # Not a number is not equal to itself, and would be a CPU of its own.
        np.nan_to_num(offers.clock_ghz, nan=-1.0),
        np.nan_to_num(offers.vcpus / offers.physical_cores, nan=-1.0),
    )
    of = row_ranks(*about)
    each = _row_of_each(of)
    kinds = zip(*(column[each].tolist() for column in about), strict=True)
    cpu = [_cpu(*one, named=one[0] in known_clouds) for one in kinds]
    return Machines(
        vcpus=offers.vcpus,
        memory_gib=offers.memory_gib,
        price_usd_per_hour=offers.price_usd_per_hour,
        family=_codes(offers.family),
        arch=_codes(offers.arch),
        cloud=_codes(offers.cloud),
        cpu_model=codes(cpu)[of],
        gpu=_codes(offers.gpu),
        gpu_count=offers.gpu_count,
        gpu_memory_gib=offers.gpu_memory_gib,
        physical_cores=offers.physical_cores,
        clock_ghz=offers.clock_ghz,
        burstable=offers.burstable,
    )


def _row_of_each(of: NDArray[np.int64]) -> NDArray[np.intp]:
    found = np.empty(int(of.max(initial=-1)) + 1, dtype=np.intp)
    found[of] = np.arange(len(of))
    return found


def _codes(column: Strings) -> NDArray[np.int64]:
    of = ranks(column)
    return codes(column[_row_of_each(of)].tolist())[of]


def _cpu(cloud: str, arch: str, family: str, clock_ghz: float, smt: float, *, named: bool) -> str:
    """Return what tells the CPU from others; numbers below 0 are unknown."""
    if clock_ghz < 0:
        return "" if named else cpu_kind(cloud, arch, family)
    return f"{cloud} {arch} {clock_ghz:g} {'nan' if smt < 0 else f'{smt:g}'}"


def types_with_measured(offers: Catalog, measured: Sequence[Machine], catalog: Catalog | None = None) -> InstanceTypes:
    """Return the types of the offers and of the measured machines, which have a row each after the offers if they are none.

    Such a row is taken from `catalog` if it is there; otherwise family, architecture and the rest are unknown. Its price
    does not matter, because it cannot be chosen.
    """
    types = instance_types(offers)
    missing = {machine.type_key: machine for machine in measured if machine.type_key not in types}
    if not missing:
        return types
    known_clouds = clocked(offers)
    rows = [_row(machine, offers, catalog) for machine in missing.values()]
    added = [machines_of(row, known_clouds) for row in rows]
    keys = list(missing)
    among = sorted(range(len(keys)), key=keys.__getitem__)
    order = np.insert(np.arange(len(types)), [types.place(keys[one]) for one in among], len(types) + np.array(among))
    place = np.argsort(order)
    cloud, instance, gpu, gpu_count = types.columns
    return InstanceTypes(
        columns=(
            np.concatenate([cloud, *(row.cloud for row in rows)])[order],
            np.concatenate([instance, *(row.instance for row in rows)])[order],
            np.concatenate([gpu, *(row.gpu for row in rows)])[order],
            np.concatenate([gpu_count, *(row.gpu_count for row in rows)])[order],
        ),
        machines=Machines(
            **{
                name: np.concatenate([getattr(one, name) for one in (types.machines, *added)])[order]
                for name in Machines.__slots__
            }
        ),
        of=place[np.concatenate([types.of, np.arange(len(types), len(order))])],
        offer=np.concatenate([types.offer, len(offers) + np.arange(len(keys))])[order],
    )


def _row(machine: Machine, offers: Catalog, catalog: Catalog | None) -> Catalog:
    if catalog is not None:
        same = (catalog.instance == machine.instance) & (catalog.cloud == machine.cloud_name) & catalog.carries(machine)
        if len(found := np.flatnonzero(same)):
            return catalog.take(found[:1])
    unknown, (gpu, gpu_count) = np.array([np.nan]), machine.accelerators
    return replace(
        offers.take(np.array([0])),
        cloud=_text(machine.cloud_name),
        instance=_text(machine.instance),
        gpu=_text(gpu),
        gpu_count=np.array([gpu_count]),
        vcpus=np.array([machine.cpus]),
        memory_gib=np.array([machine.memory]),
        region=_text(""),
        zone=_text(""),
        arch=_text(""),
        family=_text(""),
        gpu_memory_gib=unknown,
        physical_cores=unknown,
        clock_ghz=unknown,
        burstable=np.array([False]),
        spot=np.array([False]),
    )


def _text(text: str) -> Strings:
    return np.array([text], dtype=np.object_)
