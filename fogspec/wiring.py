"""Which plugin has which name: the only file that knows concrete plugins, loaded when used."""

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

from fogspec.catalog import Catalog

CATALOGS = {
    "snapshot": "fogspec.plugins.catalogs.snapshot:Snapshot",
    "csv": "fogspec.plugins.catalogs.csv_file:CsvFile",
}
RUNNERS = {
    "local": "fogspec.plugins.runners.local:LocalRunner",
    "replay": "fogspec.plugins.runners.replay:ReplayRunner",
}


def load(registry: Mapping[str, str], name: str) -> Any:
    """The plugin's class or function; raises KeyError for a name that is not registered."""
    module, _, attribute = registry[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def catalog(path: str | None, clouds: Sequence[str]) -> Catalog:
    """The catalog in the CSV file at `path`, else the bundled snapshot; `clouds` are those that the spec names."""
    source = load(CATALOGS, "csv" if path else "snapshot")
    found: Catalog = source(path or "", clouds).load()
    return found


def runner(name: str) -> Any:
    """The runner's class."""
    return load(RUNNERS, name)
