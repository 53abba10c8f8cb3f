"""Sources of machines and prices, imported when they are used."""

import importlib
import os
from collections.abc import Sequence
from typing import Protocol

from fogspec.base.clouds import LOCAL
from fogspec.catalog.table import Catalog

SOURCES = {
    "snapshot": "fogspec.catalog.sources.snapshot:Snapshot",
    "skypilot": "fogspec.catalog.sources.skypilot:SkyPilot",
    "folder": "fogspec.catalog.sources.skypilot:Folder",
    "csv": "fogspec.catalog.sources.csv:CsvFile",
}


class CatalogSource(Protocol):
    """A source of machines and prices."""

    def load(self) -> Catalog:
        """Return the whole catalog; raise InvalidInput or DiagnosticError if it cannot be read."""
        ...


def default_origin(clouds: Sequence[str]) -> str:
    """Return `host` for this host alone, `skypilot` if SkyPilot's own tables of these clouds are here, else `snapshot`."""
    if set(clouds) == {LOCAL}:
        return "host"
    return "skypilot" if has_skypilots(clouds) else "snapshot"


def serves(origin: str, clouds: Sequence[str]) -> bool:
    """Return whether a catalog that was chosen before still has these clouds, as far as its name tells: `host` is local's."""
    built_in = origin in ("host", "snapshot", "skypilot")
    return not built_in or (origin == "host") == (set(clouds) == {LOCAL})


def has_skypilots(clouds: Sequence[str]) -> bool:
    """Return whether SkyPilot's own tables of these clouds are on this machine."""
    from fogspec.catalog.sources.skypilot import SkyPilot

    return SkyPilot("", clouds).is_complete()


def load_catalog(origin: str | None, clouds: Sequence[str], machines: Sequence[str] = ()) -> Catalog:
    """Return the catalog `snapshot`, `skypilot` or `host`, or that in the directory or CSV file `origin`; None is the snapshot.

    `clouds` are those that the spec names, `machines` its `benchmark.machines`. Raise DiagnosticError or InvalidInput if it
    cannot be read.
    """
    if origin == "host":
        from fogspec.catalog.sources.host import load

        return load(machines)
    path_kind = "folder" if origin and os.path.isdir(origin) else "csv"
    kind = (origin or "snapshot") if origin in (None, "snapshot", "skypilot") else path_kind
    module, _, name = SOURCES[kind].partition(":")
    source: CatalogSource = getattr(importlib.import_module(module), name)(origin or "", clouds)
    return source.load()
