"""The catalog: every machine on offer, column by column, and the provenance of the table."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fogspec.base.clouds import cloud_of, split_infra
from fogspec.base.units import core_hours
from fogspec.catalog.machine import Gpu, Machine

Floats = NDArray[np.float64]
Strings = NDArray[np.object_]  # of str: one pointer per row, equal texts shared, so that 500,000 rows fit in memory

COUNTED = 1_000_000  # keys of rows, counted rather than sorted


@dataclass(frozen=True, slots=True)
class About:
    """Provenance of a catalog: `digest` covers the bytes that were read, `notes` report what was left out.

    `checked` is how well its prices agree with newer ones, of a catalog for which that is known. `origin` is what `--catalog`
    takes to read it again, a path relative to the project. Without prices costs are `core_hours`.
    """

    source: str
    revision: str
    date: str
    digest: str
    notes: tuple[str, ...] = ()
    checked: str | None = None
    origin: str = ""
    core_hours: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Catalog:
    """Offers as columns of equal length n; spot machines are rows of their own.

    Prices are USD per hour of the whole machine, accelerators included, and positive. Unknown numbers are NaN; a
    machine without accelerator has an empty `gpu` and a `gpu_count` of 0. Rows are in the order of `in_order`,
    so that nothing depends on the order of the source file.
    """

    about: About
    cloud: Strings
    region: Strings
    zone: Strings
    instance: Strings
    vcpus: Floats
    memory_gib: Floats
    gpu: Strings
    gpu_count: Floats
    gpu_memory_gib: Floats
    price_usd_per_hour: Floats
    spot: NDArray[np.bool_]
    arch: Strings
    family: Strings
    physical_cores: Floats
    clock_ghz: Floats
    burstable: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.instance)

    @property
    def paid_usd_per_hour(self) -> Floats:
        """Return what each machine costs with its disk and address; see `Machine.paid_usd_per_hour`."""
        return self.price_usd_per_hour + self.beside_usd_per_hour

    @property
    def beside_usd_per_hour(self) -> Floats:
        """Return what disk, address and CPU credits of each machine cost beside its price; nothing where it has none."""
        places = list(zip(self.cloud.tolist(), self.region.tolist(), strict=True))
        beside = {place: cloud_of(place[0]).beside(place[1])[0] for place in set(places)}
        usd_per_hour = np.fromiter(map(beside.__getitem__, places), np.float64, len(places))
        types = list(zip(self.cloud.tolist(), self.instance.tolist(), strict=True))
        credits = {one: cloud_of(one[0]).credit_usd_per_hour(one[1], 1.0) for one in set(types)}
        if any(credits.values()):
            usd_per_hour += self.vcpus * np.fromiter(map(credits.__getitem__, types), np.float64, len(types))
        return np.where(self.price_usd_per_hour > 0, usd_per_hour, 0.0)

    def usd(self, paid_s: float) -> Floats:
        """Return what each machine costs while it is there for so long; see `Machine.usd`."""
        billed_s = {cloud: cloud_of(cloud).billed_s(paid_s) for cloud in set(self.cloud.tolist())}
        seconds = np.fromiter(map(billed_s.__getitem__, self.cloud.tolist()), np.float64, len(self))
        return np.asarray(self.paid_usd_per_hour * seconds / 3600)

    def in_order(self) -> "Catalog":
        """Return the catalog sorted by spot, cloud, region, instance, accelerators, zone, and the rest of a row."""
        return self.take(self.order())

    def order(self) -> NDArray[np.intp]:
        """Return the row numbers in the order of `in_order`."""
        key = row_ranks(self.spot, self.cloud, self.region, self.instance, self.gpu, self.gpu_count, self.zone)
        order = np.argsort(key, kind="stable")
        same = key[order][1:] == key[order][:-1]
        if same.any():
            tied = np.flatnonzero(np.append(same, False) | np.append(False, same))
            rest = (
                "family",
                "arch",
                "clock_ghz",
                "physical_cores",
                "gpu_memory_gib",
                "burstable",
                "memory_gib",
                "vcpus",
                "price_usd_per_hour",
            )
            rows = order[tied]
            columns = [getattr(self, name)[rows] for name in rest]
            within = np.lexsort([*(ranks(one) if one.dtype == object else one for one in columns), key[rows]])
            order[tied] = rows[within]
        return order

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "Catalog":
        """Return the catalog of some of the rows: indices or a mask."""
        columns = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "about"}
        return Catalog(about=self.about, **columns)

    def merged(self) -> "Catalog":
        """Return one row for neighbours of the same machine, place and kind of price, at the highest price."""
        first = np.flatnonzero(~self.repeated())
        if len(first) == len(self):
            return self
        price = np.maximum.reduceat(self.price_usd_per_hour, first)
        return replace(self.take(first), price_usd_per_hour=price)

    def repeated(self) -> NDArray[np.bool_]:
        """Return the mask of rows with the machine, place and kind of price of the row before."""
        key = (self.spot, self.cloud, self.region, self.instance, self.gpu, self.gpu_count, self.zone)
        same = np.ones(len(self), dtype=np.bool_)
        same[:1] = False
        for column in key:
            same[1:] &= np.asarray(column[1:] == column[:-1], dtype=np.bool_)
        return same

    def machine(self, row: int) -> Machine:
        """Return the machine of one row."""
        gpu = Gpu(name=str(self.gpu[row]), count=float(self.gpu_count[row])) if self.gpu[row] else None
        return Machine(
            infra=self.infra(row),
            instance=str(self.instance[row]),
            cpus=float(self.vcpus[row]),
            memory=float(self.memory_gib[row]),
            gpu=gpu,
            spot=bool(self.spot[row]),
            price=float(self.price_usd_per_hour[row]),
        )

    def infra(self, row: int) -> str:
        """Return the place of one row: `cloud/region`, with the zone if the table has one."""
        return "/".join(part for part in (self.cloud[row], self.region[row], self.zone[row]) if part)

    def carries(self, machine: Machine) -> NDArray[np.bool_]:
        """Return the mask of rows with exactly the accelerators of this machine."""
        name, count = machine.accelerators
        return np.asarray((self.gpu == name) & (self.gpu_count == count), dtype=np.bool_)


def of_machine(machine: Machine) -> Catalog:
    """Return the catalog of one machine; what a machine does not tell is unknown."""
    cloud, region, zone = (*split_infra(machine.infra), "", "")[:3]
    gpu, count = machine.accelerators
    return Catalog(
        about=About("one machine", "", "", ""),
        cloud=strings([cloud]),
        region=strings([region]),
        zone=strings([zone]),
        instance=strings([machine.instance]),
        vcpus=np.array([machine.cpus], dtype=np.float64),
        memory_gib=np.array([machine.memory], dtype=np.float64),
        gpu=strings([gpu]),
        gpu_count=np.array([count], dtype=np.float64),
        gpu_memory_gib=np.array([np.nan]),
        price_usd_per_hour=np.array([machine.price], dtype=np.float64),
        spot=np.array([machine.spot]),
        arch=strings([""]),
        family=strings([""]),
        physical_cores=np.array([np.nan]),
        clock_ghz=np.array([np.nan]),
        burstable=np.array([False]),
    )


def strings(values: Iterable[str]) -> Strings:
    """Return a column of texts; equal ones are one object."""
    given, known = list(values), dict[str, str]()
    return np.fromiter(map(known.setdefault, given, given), dtype=np.object_)


def concatenated(catalogs: Sequence[Catalog], about: About) -> Catalog:
    """Return the catalogs, ordered and with ordered clouds, as one: the on-demand rows of all, then the spot rows."""
    parts = [*(one.take(~one.spot) for one in catalogs), *(one.take(one.spot) for one in catalogs)]
    names = [f.name for f in fields(Catalog) if f.name != "about"]
    return Catalog(about=about, **{name: np.concatenate([getattr(one, name) for one in parts]) for name in names})


class Priced(Protocol):
    """What has a catalog."""

    @property
    def catalog(self) -> Catalog:
        """The catalog of machines and prices."""


P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=Priced)


def in_its_unit(function: Callable[Concatenate[C, P], R]) -> Callable[Concatenate[C, P], R]:
    """Return a function that shows people costs in the unit of the catalog of its first argument: dollars or core-hours."""

    @wraps(function)
    def shown(one: C, /, *args: P.args, **options: P.kwargs) -> R:
        with core_hours(one.catalog.about.core_hours):
            return function(one, *args, **options)

    return shown


def each_in_its_unit(found: Iterable[C]) -> Iterator[C]:
    """Yield each of these, while costs are shown in the unit of its catalog."""
    for one in found:
        with core_hours(one.catalog.about.core_hours):
            yield one


def ranks(column: NDArray[Any]) -> NDArray[np.int64]:
    """Return each row's rank among the distinct texts, in code point order, or numbers, none NaN, of the column."""
    if not len(column) or bool((column == column[0]).all()):
        return np.zeros(len(column), dtype=np.int64)
    values = column.tolist()
    # In the order of the rows, which is mostly that of the words: they are sorted faster than a set.
    rank = {word: i for i, word in enumerate(sorted(dict.fromkeys(values)))}
    return np.fromiter(map(rank.__getitem__, values), np.int64, len(values))


def row_ranks(*columns: NDArray[Any]) -> NDArray[np.int64]:
    """Return each row's rank among the distinct rows of these columns, which are compared in this order."""
    key, most = np.zeros(len(columns[0]), dtype=np.int64), 1
    for column in columns:
        rank = ranks(column)
        each = int(rank.max(initial=0)) + 1
        if each == 1:
            continue
        key, most = key * each + rank, most * each
        if most > COUNTED:
            values, key = np.unique(key, return_inverse=True)
            key, most = key.ravel().astype(np.int64), len(values)
    return np.asarray((np.cumsum(np.bincount(key, minlength=most) > 0) - 1)[key])
