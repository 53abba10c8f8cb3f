"""Machines of Google Cloud, which prices host and accelerator in separate rows: joined, they have one price.

The rule: an accelerator joins every host of its zone that may carry it, and the machine costs host + accelerator
(SkyPilot's catalog gives the accelerator row the price of all its `AcceleratorCount` pieces). Accelerator-optimised
hosts (A2, A3, A4, G2, G4) come only with their own accelerators; N1 hosts carry T4, P4, P100 and V100 within limits.
Source: cloud.google.com/compute/docs/gpus. Accelerated hosts without accelerators, and TPUs, are not candidates.
"""

import re
from collections import defaultdict
from dataclasses import replace
from functools import cache

import numpy as np

from fogspec.base.clouds import CLOUDS, cloud_of
from fogspec.catalog.table import Catalog, Floats, strings

Card = tuple[str, float]  # accelerator and count

# accelerators -> largest vCPUs and GiB of an N1 host
N1_LIMITS: dict[str, dict[int, tuple[float, float]]] = {
    "T4": {1: (48, 312), 2: (48, 312), 4: (96, 624)},
    "P4": {1: (24, 156), 2: (48, 312), 4: (96, 624)},
    "P100": {1: (16, 104), 2: (32, 208), 4: (96, 624)},
    "V100": {1: (12, 78), 2: (24, 156), 4: (48, 312), 8: (96, 624)},
}
OWN = (
    (re.compile(r"a2-(?:high|mega)gpu-(\d+)g$"), "A100"),
    (re.compile(r"a2-ultragpu-(\d+)g$"), "A100-80GB"),
    (re.compile(r"a3-highgpu-(\d+)g$"), "H100"),
    (re.compile(r"a3-megagpu-(\d+)g$"), "H100-MEGA"),
    (re.compile(r"a3-ultragpu-(\d+)g"), "H200"),
    (re.compile(r"a4-highgpu-(\d+)g$"), "B200"),
)
OWN_BY_VCPUS = {"g2": ("L4", {24: 2, 48: 4, 96: 8}), "g4": ("RTXPRO6000", {48: 1, 96: 2, 192: 4, 384: 8})}
ACCELERATED = re.compile(CLOUDS["gcp"].accelerated or "")
N1 = re.compile(r"n1-(standard|highmem|highcpu)-\d+$")


def joined(catalog: Catalog, spot: Floats) -> tuple[Catalog, Floats]:
    """Return the machines of a table with accelerators in rows without an instance type, and their spot prices.

    `spot` has one spot price per row, NaN if there is none.
    """
    host = catalog.instance != ""
    if host.all():
        return catalog, spot
    at: dict[tuple[str, str, str], dict[Card, int]] = defaultdict(dict)
    for row in np.flatnonzero(~host).tolist():
        at[_place(catalog, row)][catalog.gpu[row], float(catalog.gpu_count[row])] = row
    attaching = {name for name in set(catalog.cloud.tolist()) if cloud_of(name).attaches_gpus}
    alone, hosts, cards = [], [], []
    for row in np.flatnonzero(host).tolist():
        name, place = catalog.instance[row], _place(catalog, row)
        if place[0] not in attaching or catalog.gpu[row]:
            alone.append(row)
            continue
        may_stand_alone, carried = _machine(name, float(catalog.vcpus[row]), float(catalog.memory_gib[row]))
        if may_stand_alone:
            alone.append(row)
        here = at.get(place)
        found = [here[card] for card in carried if card in here] if here else []
        hosts += [row] * len(found)
        cards += found
    rows = np.array(alone + hosts, dtype=np.intp)
    machines, spots = catalog.take(rows), spot[rows].copy()
    _add_cards(machines, spots, catalog=catalog, spot=spot, first=len(alone), cards=np.array(cards, dtype=np.intp))
    return replace(machines, gpu=strings(machines.gpu.tolist())), spots


def _place(catalog: Catalog, row: int) -> tuple[str, str, str]:
    return catalog.cloud[row], catalog.region[row], catalog.zone[row]


@cache
def _machine(name: str, vcpus: float, memory_gib: float) -> tuple[bool, tuple[Card, ...]]:
    """Return whether the host is rented without accelerators, and the accelerators that it carries where offered."""
    if own := _own(name, vcpus):
        return not ACCELERATED.match(name), (own,)
    if not N1.match(name):
        return not ACCELERATED.match(name), ()
    limits = ((gpu, float(count), top) for gpu, tops in N1_LIMITS.items() for count, top in tops.items())
    return True, tuple((gpu, count) for gpu, count, top in limits if vcpus <= top[0] and memory_gib <= top[1])


def _own(name: str, vcpus: float) -> Card | None:
    for pattern, gpu in OWN:
        if match := pattern.match(name):
            return gpu, float(match[1])
    family = OWN_BY_VCPUS.get(name.split("-")[0])
    return (family[0], float(family[1].get(int(vcpus), 1))) if family and np.isfinite(vcpus) else None


def _add_cards(
    machines: Catalog, spots: Floats, *, catalog: Catalog, spot: Floats, first: int, cards: np.ndarray
) -> None:
    """Write accelerators and their prices into the rows from `first` on, which are copies."""
    for name in ("gpu", "gpu_count", "gpu_memory_gib"):
        getattr(machines, name)[first:] = getattr(catalog, name)[cards]
    machines.price_usd_per_hour[first:] += catalog.price_usd_per_hour[cards]
    spots[first:] += spot[cards]
