"""Filters from every machine on offer to those that a spec admits, each with a count of the offers that it removed."""

import difflib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.base.clouds import CLOUDS, cloud_name, is_zone, split_infra
from fogspec.base.units import Range
from fogspec.catalog import classes
from fogspec.catalog.machine import Gpu, Machine
from fogspec.catalog.table import Catalog, Floats, Strings, concatenated, of_machine
from fogspec.language.schema import CLASSES, STANDARD, Hardware, MachineClass, Spec

Mask = NDArray[np.bool_]
ALLOW, DENY = "hardware.allow", "hardware.deny"
STARTED, IMAGES = "what SkyPilot can start", "where SkyPilot starts images"
PLACES_IN_ZONES = {cloud.name for cloud in CLOUDS.values() if cloud.places_in_zones}


@dataclass(frozen=True, slots=True)
class Filter:
    """One filter: the field of the spec, and the number of offers that it removed and left."""

    name: str
    removed: int
    left: int


@dataclass(frozen=True, slots=True)
class FilterCounts:
    """The counts of all filters over `offered` offers."""

    offered: int
    filters: tuple[Filter, ...]

    @property
    def admitted(self) -> int:
        """Return the number of offers left."""
        return self.filters[-1].left if self.filters else self.offered

    def line(self) -> str:
        """Return the counts in one line: `94,800 offers -> 6,306 after infra -> ...`."""
        steps = [f"{f.left:,} after {f.name}" for f in self.filters if f.removed]
        return " -> ".join([f"{self.offered:,} offers", *steps])


@dataclass(frozen=True, slots=True)
class Filtered:
    """The admissible offers, one for each machine, place and kind of price, and the counts of the filters."""

    offers: Catalog
    funnel: FilterCounts
    left_out: Mapping[MachineClass, int]  # instance types that only their class keeps out

    def left_out_line(self) -> str | None:
        """Return `left out: 38 burstable`, the field that admits them, and what SkyPilot cannot start; None without any."""
        found = []
        if self.left_out:
            counts = ", ".join(f"{count:,} {name}" for name, count in self.left_out.items())
            found.append(
                f"left out: {counts}; to admit them: spec.hardware.allow: [{', '.join((STANDARD, *self.left_out))}]"
            )
        for name, why in (
            (STARTED, "that SkyPilot cannot start"),
            (IMAGES, "where SkyPilot starts no container images"),
        ):
            if removed := next((one.removed for one in self.funnel.filters if one.name == name), 0):
                found.append(f"left out: {removed:,} offer{'' if removed == 1 else 's'} {why}")
        return "; ".join(found) or None


def offers_for(catalog: Catalog, spec: Spec) -> Filtered:
    """Return the offers that a spec admits; see `filter_offers`."""
    return filter_offers(catalog, spec.hardware, spec.infra, image=spec.ros is not None and spec.ros.image is not None)


def filter_offers(catalog: Catalog, hardware: Hardware, infra: Sequence[str], image: bool = False) -> Filtered:
    """Return the offers that `hardware` and `infra` admit, in the order of the catalog; with an `image`, where one can run.

    Zones of one region are merged into one offer at the highest of their prices, because a task pins the region and
    may be given any zone of it; an `infra` that names a zone keeps its offers apart.
    """
    filters: list[Filter] = []
    catalog = in_zones(catalog, infra)
    offers, left_out = catalog, dict[MachineClass, Catalog]()
    for name, mask in _filters(hardware, infra, image):
        kept = mask(offers)
        removed = len(kept) - int(kept.sum())
        left_out = {kind: rows.take(mask(rows)) for kind, rows in left_out.items()}
        if removed and name == ALLOW and STANDARD in hardware.allow:
            masks = {kind: of_class & ~kept for kind, of_class in classes.left_out(offers).items()}
            left_out = {kind: offers.take(rest) for kind, rest in masks.items() if rest.any()}
        if removed:
            offers = offers.take(kept)
        filters.append(Filter(name, removed, len(offers)))
    merged = merge_zones(offers, infra)
    filters.append(Filter("zones of one region merged", len(offers) - len(merged), len(merged)))
    types = {kind: len(set(zip(rows.cloud, rows.instance, strict=True))) for kind, rows in left_out.items()}
    counts = FilterCounts(len(catalog), tuple(filters))
    return Filtered(merged, counts, {kind: count for kind, count in types.items() if count})


def matches_infra(catalog: Catalog, entry: str) -> Mask:
    """Return the mask of offers in `cloud`, `cloud/region` or `cloud/region/zone`; `*` matches any."""
    mask = np.ones(len(catalog), dtype=np.bool_)
    for column, part in zip((catalog.cloud, catalog.region, catalog.zone), split_infra(entry), strict=False):
        if part != "*":
            mask &= _equal(column, part.lower() if column is catalog.cloud else part)
    return mask


def in_zones(catalog: Catalog, infra: Sequence[str]) -> Catalog:
    """Return the catalog with the offers that name no zone, which are in every one of their region, in those of `infra`."""
    added = []
    for entry in infra:
        place, _, zone = entry.rpartition("/")
        if len(split_infra(entry)) == 3 and zone != "*" and is_zone(entry):
            rows = catalog.take(matches_infra(catalog, place) & _equal(catalog.zone, ""))
            added.append(replace(rows, zone=np.full_like(rows.zone, zone)))
    return concatenated([catalog, *added], catalog.about).in_order().merged() if any(map(len, added)) else catalog


def unknown_places(infra: Sequence[str], catalog: Catalog) -> Iterator[str]:
    """Yield a hint for each entry of `infra` in which the catalog has no machine at all."""
    catalog = in_zones(catalog, infra)
    for entry in infra:
        if matches_infra(catalog, entry).any():
            continue
        places = {*catalog.cloud, *map("/".join, zip(catalog.cloud, catalog.region, strict=True))}
        close = difflib.get_close_matches(entry, sorted(places), n=3)
        hint = ""
        if close:
            hint = f"; did you mean {', '.join(close)}?"
        elif cloud_name(entry) not in places:
            hint = "; --catalog takes a list of its machines and prices, and fogspec lock pins it"
        yield f"the catalog has no machine in {entry}{hint}"


def gpu_type(text: str) -> Gpu | None:
    """Return the accelerators that a spec names: one T4 for `T4` and `T4:1`, four for `T4:4`, None for `none`."""
    if text.strip().lower() == "none":
        return None
    name, _, count = text.partition(":")
    return Gpu(name=name.strip(), count=float(count) if count.strip() else 1.0)


def matches_gpu(catalog: Catalog, text: str) -> Mask:
    """Return the mask of offers with exactly these accelerators, ignoring case; `none` is none of any kind, FPGAs too."""
    gpu = gpu_type(text)
    if gpu is None:
        return ~classes.accelerated(catalog)
    spellings = {name for name in set(catalog.gpu.tolist()) if name.lower() == gpu.name.lower()}
    return _within(catalog.gpu, spellings) & np.asarray(catalog.gpu_count == gpu.count, dtype=np.bool_)


def field_against(machine: Machine, hardware: Hardware, infra: Sequence[str]) -> str | None:
    """Return the first field of the spec that does not admit the machine, by what a plan says of it; None if all do.

    A plan does not tell architecture and class.
    """
    one = of_machine(machine)
    by_class = [name for name, entries in ((ALLOW, hardware.allow), (DENY, hardware.deny)) if {*CLASSES} & {*entries}]
    told = (found for found in _filters(hardware, infra) if found[0] not in ("hardware.arch", *by_class))
    return next((name for name, mask in told if not mask(one)[0]), None)


def matches_names(catalog: Catalog, patterns: Sequence[str]) -> Mask:
    """Which offers have an instance type that one of the patterns names; `*` matches any text."""
    fits = _pattern(patterns).fullmatch
    return _within(catalog.instance, {name for name in set(catalog.instance.tolist()) if fits(name)})


def _filters(
    hardware: Hardware, infra: Sequence[str], image: bool = False
) -> list[tuple[str, Callable[[Catalog], Mask]]]:
    return [
        ("infra", lambda c: _any(c, [matches_infra(c, entry) for entry in infra])),
        (STARTED, classes.startable),
        *([(IMAGES, classes.takes_images)] if image else []),
        ("hardware.spot", lambda c: np.full(len(c), True) if hardware.spot else ~c.spot),
        ("hardware.arch", lambda c: _within(c.arch, set(hardware.arch))),
        (ALLOW, lambda c: _listed(c, hardware.allow)),
        ("hardware.gpus", lambda c: _any(c, [matches_gpu(c, text) for text in hardware.gpus])),
        ("hardware.cpus", lambda c: _inside(c.vcpus, hardware.cpus)),
        ("hardware.memory", lambda c: _inside(c.memory_gib, hardware.memory)),
        ("hardware.memory_per_cpu", lambda c: _inside(c.memory_gib / c.vcpus, hardware.memory_per_cpu)),
        (DENY, lambda c: ~_listed(c, hardware.deny)),
    ]


def _listed(catalog: Catalog, entries: Sequence[str]) -> Mask:
    """Return the mask of offers whose instance type or class is one of the entries."""
    listed = matches_names(catalog, [one for one in entries if one not in CLASSES])
    if not {*CLASSES} & {*entries}:
        return listed
    masks = classes.left_out(catalog)
    standard = [~_any(catalog, list(masks.values()))] if STANDARD in entries else []
    return _any(catalog, [listed, *standard, *(mask for kind, mask in masks.items() if kind in entries)])


def before_empty(catalog: Catalog, hardware: Hardware, infra: Sequence[str]) -> str | None:
    """Return the values available just before the filter that removed the last offers, as a hint; None without one."""
    offers = catalog
    for name, mask in _filters(hardware, infra):
        kept = offers.take(mask(offers))
        if not len(kept) and len(offers):
            values = {
                "hardware.gpus": lambda c: sorted({str(gpu) for gpu in c.gpu if gpu}) or ["none"],
                "hardware.cpus": lambda c: [f"{value:g}" for value in sorted(set(c.vcpus.tolist()))],
                "hardware.memory": lambda c: [f"{value:g} GiB" for value in sorted(set(c.memory_gib.tolist()))],
            }.get(name)
            return None if values is None else f"on offer there for {name}: {_shortened(values(offers))}"
        offers = kept
    return None


def _shortened(names: list[str]) -> str:
    return ", ".join(names if len(names) <= 16 else [*names[:8], "...", *names[-4:]])


def price_now(machine: Machine, catalog: Catalog) -> float | None:
    """Return the price in USD per hour, the highest among the zones of its region; None if it is not on offer."""
    offers = catalog.take(_equal(catalog.instance, machine.instance))
    offers = in_zones(offers, [machine.infra])
    same = matches_infra(offers, machine.infra) & (offers.spot == machine.spot) & offers.carries(machine)
    return float(offers.price_usd_per_hour[same].max()) if same.any() else None


def merge_zones(offers: Catalog, infra: Sequence[str]) -> Catalog:
    """Return one offer for all zones of a region that `infra` does not name, at the highest of their prices.

    `offers` are in the order of the catalog, which puts the zones of one machine and region together. Zones that have
    machines and prices of their own, such as the partitions of a Slurm cluster, stay apart.
    """
    pinned = _any(offers, [matches_infra(offers, entry) for entry in infra if len(split_infra(entry)) == 3])
    whole = _any(offers, [matches_infra(offers, entry) for entry in infra if len(split_infra(entry)) < 3])
    zone = offers.zone.copy()
    zone[(whole | ~pinned) & ~_within(offers.cloud, PLACES_IN_ZONES)] = ""
    return replace(offers, zone=zone).merged()


def _any(catalog: Catalog, masks: Sequence[Mask]) -> Mask:
    found = np.zeros(len(catalog), dtype=np.bool_)
    for mask in masks:
        found |= mask
    return found


def _equal(column: Strings, text: str) -> Mask:
    return np.asarray(column == text, dtype=np.bool_)


def _within(column: Strings, names: set[str]) -> Mask:
    return np.fromiter(map(names.__contains__, column.tolist()), np.bool_, len(column))


def _inside(values: Floats, bounds: Range | None) -> Mask:
    """Return the mask of values within the bounds, both ends included, to a relative 1e-9: 16 GiB may be given in MB."""
    found = np.ones(len(values), dtype=np.bool_)
    if bounds is not None and bounds.low is not None:
        found &= values >= bounds.low * (1 - 1e-9)
    if bounds is not None and bounds.high is not None:
        found &= values <= bounds.high * (1 + 1e-9)
    return found


def _pattern(patterns: Sequence[str]) -> re.Pattern[str]:
    """Return the expression of patterns in which only `*` is special, unlike in fnmatch."""
    return re.compile("|".join(".*".join(map(re.escape, pattern.split("*"))) for pattern in patterns))
