"""Classes of machines that are candidates only when a spec includes them, and kinds of CPU; both from the catalog's names.

A machine without accelerators is of a previous generation if the cloud itself calls its family so, or if its place
offers three newer generations of the same series and architecture: of m5, m6i, m6a, m7i and m8i, m5 is one. So the rule
follows the catalog, and a region that has nothing newer keeps what it has. A GPU is named by the spec, whatever its host.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fogspec.base.clouds import CLOUDS, Cloud, OwnEnd, cloud_of
from fogspec.catalog.table import Catalog, Strings
from fogspec.language.schema import MachineClass

Mask = NDArray[np.bool_]
CURRENT = 3  # generations of a series
# With less, what SkyPilot runs beside the nodes is a large part: Ray and its own daemon take 0.6 to 1 GiB, and Ray ends what
# runs at 95% (docs.ray.io, "Out-Of-Memory Prevention").
LOW_GIB = 4.0 * (1 - 1e-9)


def accelerated(offers: Catalog) -> Mask:
    """Return the mask of machines with an accelerator of any kind, named by the catalog or known by the instance type."""
    found = offers.gpu != ""
    for cloud, here in _clouds(offers):
        found |= here & _matching(offers.instance, cloud.accelerated)
    return np.asarray(found, dtype=np.bool_)


def startable(offers: Catalog) -> Mask:
    """Return the mask of machines that SkyPilot can start, as far as their instance types tell."""
    found = np.ones(len(offers), dtype=np.bool_)
    for cloud, here in _clouds(offers):
        found &= ~(here & _matching(offers.instance, cloud.unstartable))
    return found


def takes_images(offers: Catalog) -> Mask:
    """Return the mask of machines that run a container image, or of a cluster that never does, and says so."""
    found = np.ones(len(offers), dtype=np.bool_)
    for cloud, here in _clouds(offers):
        found &= ~here | (cloud.containers or cloud.own_end is OwnEnd.JOB_TIME_LIMIT)
    return found


def burstable(offers: Catalog) -> Mask:
    """Return the mask of machines whose CPU is guaranteed for part of the time only."""
    found = offers.burstable.copy()
    for cloud, here in _clouds(offers):
        found |= here & _matching(offers.instance, cloud.burstable)
    return found


def left_out(offers: Catalog) -> dict[MachineClass, Mask]:
    """Return the mask of each class that is not a candidate by default; the masks are disjoint.

    `offers` are all of the places and architectures that a spec names, for generations are counted among them.
    """
    plain = ~accelerated(offers)
    previous = plain & _previous(offers, plain)
    bursts = plain & burstable(offers) & ~previous
    return {
        "previous-generation": previous,
        "burstable": bursts,
        "low-memory": _low_memory(offers) & ~previous & ~bursts,
        "bare-metal": plain & _bare_metal(offers) & ~previous,
    }


def _bare_metal(offers: Catalog) -> Mask:
    """Return the mask of whole servers, without a hypervisor."""
    found = np.zeros(len(offers), dtype=np.bool_)
    for cloud, here in _clouds(offers):
        found |= here & _matching(offers.instance, cloud.bare_metal)
    return found


def _low_memory(offers: Catalog) -> Mask:
    """Return the mask of a cloud's machines with little memory; who asks for the shape of a pod or a job means it."""
    found = np.zeros(len(offers), dtype=np.bool_)
    for cloud, here in _clouds(offers):
        found |= here & (cloud.name in CLOUDS and cloud.instance_types)
    return found & np.asarray(offers.memory_gib < LOW_GIB, dtype=np.bool_)


def platforms(offers: Catalog) -> Strings:
    """Return the kind of CPU (n,) that the families' names tell, such as `6i` of c6i, m6i and r6i; "" if they do not."""
    found = np.full(len(offers), "", dtype=np.object_)
    for cloud, here in _clouds(offers):
        if cloud.platform is not None:
            names = {family: _platform(cloud.platform, family) for family in set(offers.family[here].tolist())}
            found[here] = [names[family] for family in offers.family[here].tolist()]
    return found


def cpu_kind(cloud: str, arch: str, family: str) -> str:
    """Return what stands for the name of a CPU that no catalog has: a family's machines share one, others may have another.

    It is empty for clouds whose names tell no CPU, such as Slurm's shapes.
    """
    return f"{cloud} {arch} {family}" if family and cloud_of(cloud).platform is not None else ""


def unknown_families(offers: Catalog) -> dict[str, list[str]]:
    """Return the families by cloud, sorted, whose names are not like those of their cloud; clouds without any are absent."""
    found = {}
    for cloud, here in _clouds(offers):
        if cloud.generation is not None:
            families = set(offers.family[here].tolist())
            found[cloud.name] = sorted(family for family in families if not _generation(cloud.generation, family))
    return {cloud: families for cloud, families in found.items() if families}


def _previous(offers: Catalog, counted: Mask) -> Mask:
    found = np.zeros(len(offers), dtype=np.bool_)
    for cloud, here in _clouds(offers):
        if cloud.generation is None:
            continue
        for arch in set(offers.arch[here].tolist()):
            rows = here & counted & np.asarray(offers.arch == arch, dtype=np.bool_)
            families = set(offers.family[rows].tolist())
            found |= rows & _within(offers.family, _old(cloud, families))
    return found


def _old(cloud: Cloud, families: set[str]) -> set[str]:
    numbers: dict[str, set[int]] = defaultdict(set)
    known = {family: _generation(cloud.generation or "", family) for family in families}
    for series, number in filter(None, known.values()):
        numbers[series].add(number)
    named = re.compile(cloud.previous or "(?!)").fullmatch
    return {
        family
        for family, generation in known.items()
        if named(family) or (generation and sum(number > generation[1] for number in numbers[generation[0]]) >= CURRENT)
    }


@cache
def _generation(pattern: str, family: str) -> tuple[str, int] | None:
    match = re.match(pattern, family)
    return (match["series"], int(match["number"] or 1)) if match else None


@cache
def _platform(pattern: str, family: str) -> str:
    match = re.match(pattern, family)
    return "".join(part or "" for part in match.groups()) if match else ""


def _clouds(offers: Catalog) -> Iterator[tuple[Cloud, Mask]]:
    for name in sorted(set(offers.cloud.tolist())):
        yield cloud_of(name), np.asarray(offers.cloud == name, dtype=np.bool_)


def _matching(column: Strings, pattern: str | None) -> Mask:
    if pattern is None:
        return np.zeros(len(column), dtype=np.bool_)
    match = re.compile(pattern).match
    return _within(column, {name for name in set(column.tolist()) if match(name)})


def _within(column: Strings, names: set[str]) -> Mask:
    return np.fromiter(map(names.__contains__, column.tolist()), np.bool_, len(column))
