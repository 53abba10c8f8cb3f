"""Zones by the names that SkyPilot takes: its tables of AWS have ids, which the names of an account stand for.

`use1-az1` is one zone, `us-east-1a` another one in each account. SkyPilot writes the names of an account beside its table,
as `az_mappings-<account>.csv` with the columns AvailabilityZone and AvailabilityZoneName.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from fogspec.base import digest
from fogspec.base.clouds import CLOUDS
from fogspec.base.csv_table import MOST_BYTES, parse_csv
from fogspec.base.errors import InvalidInput
from fogspec.base.files import read_bounded
from fogspec.catalog.table import Catalog, strings

NAMES = "az_mappings-*.csv"
ID, NAME = "AvailabilityZone", "AvailabilityZoneName"
PATTERNS = {cloud.name: re.compile(cloud.zone_id) for cloud in CLOUDS.values() if cloud.zone_id}


def by_name(catalog: Catalog, table: Path, shown: str) -> Catalog:
    """Return the catalog of a table with zones by name, from the account's names beside it.

    Without them, or with those of several accounts, such a zone's offers are those of its region, at the highest price; a
    note says so. Raises DiagnosticError or InvalidInput for names that cannot be read.
    """
    pairs = list(zip(catalog.cloud.tolist(), catalog.zone.tolist(), strict=True))
    ids = {(one, zone) for one, zone in set(pairs) if one in PATTERNS and PATTERNS[one].fullmatch(zone)}
    is_id = np.fromiter(map(ids.__contains__, pairs), np.bool_, len(pairs))
    if not is_id.any():
        return catalog
    about, files = catalog.about, sorted(table.parent.glob(NAMES))
    names: Mapping[str, str] = {}
    if len(files) == 1:
        names, read = _names(files[0])
        about = replace(about, digest=digest.of_value([about.digest, read]))
        note = "zones that the account does not have are left out"
        catalog = catalog.take(~is_id | np.fromiter(map(names.__contains__, catalog.zone), np.bool_, len(catalog)))
    else:
        which = f"the names of {len(files)} accounts are" if files else "no account's names for them are"
        note = f"zones have ids, and {which} beside it ({NAMES}): the highest price in each region counts"
        names = dict.fromkeys(catalog.zone[is_id].tolist(), "")
    named = replace(catalog, zone=strings([names.get(zone, zone) for zone in catalog.zone.tolist()]))
    return replace(named.in_order().merged(), about=replace(about, notes=(*about.notes, f"{shown}: {note}")))


def _names(path: Path) -> tuple[dict[str, str], str]:
    """Return names by ids, and the digest of the file."""
    try:
        content = read_bounded(path, MOST_BYTES)
    except OSError as problem:
        raise InvalidInput(f"{path}: the names of zones cannot be read: {problem.strerror}") from None
    rows = parse_csv(content, str(path), (ID, NAME), code="FS401", what="a list of zones")
    names = dict(zip(rows.shared(ID).tolist(), rows.shared(NAME).tolist(), strict=True))
    rows.check()
    return names, digest.of_bytes(content)
