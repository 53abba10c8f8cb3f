"""Regions, zones and instance types that a spec names, against the names that catalogs have.

The bundled list's names are a small file of their own, so that a spec whose names are right costs no catalog. What is not in
it is looked up in the catalog that `compile` would read. A cloud that neither has is not judged.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from fogspec.base.clouds import LOCAL, cloud_name, cloud_of, is_zone, is_zone_id, split_infra
from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.yaml.positions import Path as FieldPath
from fogspec.base.yaml.positions import dotted, span_of
from fogspec.language.loader import LoadedSpec
from fogspec.language.schema import CLASSES, Spec
from fogspec.language.suggest import closest

if TYPE_CHECKING:
    from fogspec.catalog.table import Catalog

CODE = "FS547"
BUNDLED = Path(__file__).parent / "sources" / "snapshot_names.json"
# SkyPilot's names of accelerators, as of version 0.14, without those of TPUs, which begin alike.
GPUS = (
    "none", "T4", "T4g", "L4", "L40", "L40S", "A10", "A10G", "A16", "A30", "A40", "A100", "A100-80GB", "H100",
    "H100-MEGA", "H200", "GH200", "B200", "GB200", "B300", "V100", "V100-32GB", "P100", "P4", "K80", "M60", "M4000",
    "P4000", "P5000", "RTX4000", "RTX5000", "RTX6000", "RTX5880-Ada", "RTX6000-Ada", "RTXPRO6000", "RTXPRO6000WS",
    "RTX PRO 4500", "RTX PRO Server 6000", "A4000", "A5000", "A6000", "RTXA4000", "RTXA5000", "RTXA6000", "MI25",
    "MI100", "MI200", "MI300X", "Radeon MI25", "Radeon Pro V520", "Gaudi HL-205", "Inferentia", "Inferentia2",
    "Trainium", "Trainium2", "RTX3060", "RTX3070", "RTX3080", "RTX3090", "RTX4060", "RTX4070", "RTX4080", "RTX4090",
    "RTX5070", "RTX5080", "RTX5090",
)  # fmt: skip
TPU = "tpu-"
MOST_NEAR = 3
SHORTEST_START = 4
NEWER = "if it is new, give compile a list that has it: --catalog"
Unknown = tuple[FieldPath, str, str]  # where, the sentence's end, and the fix


@dataclass(frozen=True, slots=True)
class Names:
    """What catalogs know: regions of a cloud, zones of `cloud/region`, and instance types of a cloud."""

    regions: Mapping[str, frozenset[str]]
    zones: Mapping[str, frozenset[str]]
    instances: Mapping[str, frozenset[str]]
    gpus: frozenset[str] = frozenset(GPUS)

    @classmethod
    def of(cls, catalog: "Catalog") -> "Names":
        """Return the names in a catalog."""
        clouds, regions = catalog.cloud.tolist(), catalog.region.tolist()
        triples = set(zip(clouds, regions, catalog.zone.tolist(), strict=True))
        places = {(f"{cloud}/{region}", zone) for cloud, region, zone in triples if (cloud, region, "") not in triples}
        return cls(
            _grouped(set(zip(clouds, regions, strict=True))),
            _grouped(places),
            _grouped(set(zip(clouds, catalog.instance.tolist(), strict=True))),
            frozenset(GPUS) | {one for one in catalog.gpu.tolist() if one},
        )

    def __or__(self, other: "Names") -> "Names":
        """Return what either knows."""
        pairs = ((self.regions, other.regions), (self.zones, other.zones), (self.instances, other.instances))
        regions, zones, instances = (
            {key: a.get(key, frozenset()) | b.get(key, frozenset()) for key in {*a, *b}} for a, b in pairs
        )
        return Names(regions, zones, instances, self.gpus | other.gpus)


@cache
def bundled() -> Names:
    """Return the names that the sources of the bundled catalog have, with a price or without."""
    found = json.loads(BUNDLED.read_text(encoding="utf-8"))
    regions, instances = (
        {cloud: frozenset(one[kind]) for cloud, one in found.items()} for kind in ("regions", "instances")
    )
    return Names(regions, {}, instances)


def unknown_names(one: LoadedSpec, catalog: "Callable[[], Catalog | None]") -> list[Diagnostic]:
    """Return warnings for what no catalog here knows; `catalog` reads the one of the spec, None for the bundled one."""
    spec, known = one.application.spec, bundled()
    strange = {cloud_name(entry) for entry in spec.infra} - {*known.regions, LOCAL}
    if not strange and not any(_unknown(spec, known)):
        return []
    try:
        found = catalog()
    except (FogspecError, DiagnosticError):
        return []  # compile says what is wrong with it
    if found is not None:
        known |= Names.of(found)
    said = [
        Diagnostic(CODE, f"{dotted(path)} {message}", span_of(one.node, path), fix, severity="warning")
        for path, message, fix in _unknown(spec, known)
    ]
    return one.texts.shown(said)


def _unknown(spec: Spec, known: Names) -> Iterator[Unknown]:
    for i, entry in enumerate(spec.infra):
        yield from _unknown_place(("spec", "infra", i), entry, known)
    yield from unknown_gpus(spec, known.gpus)
    clouds = {cloud_name(entry) for entry in spec.infra} - {LOCAL}
    if not all(cloud in known.instances and cloud_of(cloud).instance_types for cloud in clouds):
        return
    types = frozenset[str]().union(*(known.instances[cloud] for cloud in clouds))
    listed = enumerate(spec.benchmark.machines)
    named: list[tuple[FieldPath, str]] = [
        (("spec", "benchmark", "machines", i), name) for i, name in listed if not name.startswith(LOCAL)
    ]
    allowed = enumerate(spec.hardware.allow)
    named += [(("spec", "hardware", "allow", i), one) for i, one in allowed if one not in CLASSES]
    for path, name in named:
        fits = re.compile(".*".join(map(re.escape, name.split("*"))))
        if name not in types and ("*" not in name or not any(map(fits.fullmatch, types))):
            families = {f"{one.partition('.')[0]}.*" for one in types} if name.endswith(".*") else types
            yield path, f"names {name}, and no catalog here has such an instance type", _fix(name, families)


def unknown_gpus(spec: Spec, known: Iterable[str]) -> Iterator[Unknown]:
    """Yield the GPUs that no catalog has: a name that none has excludes every machine that was meant. Case does not count."""
    listed = {one.lower(): one for one in known}
    for i, text in enumerate(spec.hardware.gpus):
        name = text.partition(":")[0].strip()
        if name.lower() in listed or name.lower().startswith(TPU):
            continue
        bare = re.sub(r"(?i)\b(nvidia|tesla|geforce|amd|intel)\b[-_ ]*|[-_ ]*\bgpus?$", "", name).strip()
        sized = re.sub(r"-\d+GB?$", "", bare)  # SkyPilot's plain name is that of the first size: A100 has 40 GB
        near = listed.get(sized.lower()) or closest(bare, list(listed.values()))
        fix = f"write '{near}{text[len(name) :]}'" if near else NEWER
        yield ("spec", "hardware", "gpus", i), f"names {name}, and no catalog here has such a GPU", fix


def _unknown_place(path: FieldPath, entry: str, known: Names) -> Iterator[Unknown]:
    cloud, region, zone = (*split_infra(entry), "*", "*")[:3]
    regions = known.regions.get(cloud)
    if regions is None or region == "*" or is_zone_id(entry):
        return
    if region not in regions:
        places = {f"{cloud}/{one}" for one in regions}
        yield path, f"names {cloud}/{region}, and no catalog here has that region", _fix(f"{cloud}/{region}", places)
        return
    zones = known.zones.get(f"{cloud}/{region}")
    if zone != "*" and (zone not in zones if zones else not is_zone(entry)):
        places = {f"{cloud}/{region}/{one}" for one in zones or ()}
        fix = _fix(entry, places) if zones else f"a zone's name begins with its region's: {region}"
        yield path, f"names {entry}, and no catalog here has that zone", fix


def _fix(name: str, known: Iterable[str]) -> str:
    near = nearest(name, known)
    return "write " + " or ".join(f"'{one}'" for one in near) if near else NEWER


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """Return the names that were probably meant: those one slip away, else the few that begin like it.

    A slip is a letter left out, added, swapped or changed. A changed digit is none: `c8i` is another family than `c7i`.
    """
    meant = _letters(name)
    plain = {one: _letters(one) for one in sorted(known)}
    slips = [one for one, letters in plain.items() if _one_slip(meant, letters)]
    starts = [one for one, letters in plain.items() if len(meant) >= SHORTEST_START and letters.startswith(meant)]
    found = slips or starts
    return found if len(found) <= MOST_NEAR else []


def _one_slip(a: str, b: str) -> bool:
    if abs(len(a) - len(b)) > 1:
        return False
    while a and b and a[0] == b[0]:
        a, b = a[1:], b[1:]
    while a and b and a[-1] == b[-1]:
        a, b = a[:-1], b[:-1]
    if len(a) == 2 and a == b[::-1]:
        return True
    return max(len(a), len(b)) <= 1 and not (a.isdigit() and b.isdigit())


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9*]", "", name.lower())


def _grouped(pairs: Iterable[tuple[str, str]]) -> dict[str, frozenset[str]]:
    found: dict[str, set[str]] = {}
    for key, value in pairs:
        found.setdefault(key, set()).add(value)
    return {key: frozenset(values) for key, values in found.items()}
