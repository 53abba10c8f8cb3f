"""Sources of machines and prices, imported when they are used."""

import importlib
import os
from collections.abc import Sequence
from typing import Protocol

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
    """Return `skypilot` if SkyPilot's own tables of these clouds are on this machine, else `snapshot`."""
    from fogspec.catalog.sources.skypilot import SkyPilot

    return "skypilot" if SkyPilot("", clouds).is_complete() else "snapshot"


def load_catalog(origin: str | None, clouds: Sequence[str]) -> Catalog:
    """Return the catalog `snapshot` or `skypilot`, or the one in the directory or CSV file `origin`; None is the snapshot.

    `clouds` are those that the spec names. Raise DiagnosticError or InvalidInput if it cannot be read.
    """
    path_kind = "folder" if origin and os.path.isdir(origin) else "csv"
    kind = (origin or "snapshot") if origin in (None, "snapshot", "skypilot") else path_kind
    module, _, name = SOURCES[kind].partition(":")
    source: CatalogSource = getattr(importlib.import_module(module), name)(origin or "", clouds)
    return source.load()
