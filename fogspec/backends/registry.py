"""Which plugin has which name: the only file that knows concrete plugins, loaded when used."""

import importlib
import os
from collections.abc import Mapping, Sequence
from typing import Any

from fogspec.backends.protocol import CatalogSource, Deployer, ImageRegistry
from fogspec.base.clouds import cloud_of
from fogspec.catalog.table import Catalog

CATALOGS = {
    "snapshot": "fogspec.catalog.sources.snapshot:Snapshot",
    "skypilot": "fogspec.catalog.sources.skypilot:SkyPilot",
    "folder": "fogspec.catalog.sources.skypilot:Folder",
    "csv": "fogspec.catalog.sources.csv:CsvFile",
}
REGISTRIES = {"distribution": "fogspec.backends.images.registry:Registry"}
RUNNERS = {
    "local": "fogspec.backends.local.runner:LocalRunner",
    "replay": "fogspec.backends.replay:ReplayRunner",
    "skypilot": "fogspec.backends.skypilot.runner:SkyPilotRunner",
}
DEPLOYERS = {
    "local": "fogspec.backends.local.deployer:LocalDeployer",
    "skypilot": "fogspec.backends.skypilot.deployer:SkyPilotDeployer",
}


def load(registry: Mapping[str, str], name: str) -> Any:
    """The plugin's class or function; raises KeyError for a name that is not registered."""
    module, _, attribute = registry[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def catalog(path: str | None, clouds: Sequence[str]) -> Catalog:
    """The catalog `snapshot` or `skypilot`, else that in the folder or CSV file at `path`; the snapshot without one.

    `clouds` are those that the spec names. Raises DiagnosticError or InvalidInput.
    """
    kind = path if path in (None, "snapshot", "skypilot") else "folder" if os.path.isdir(path) else "csv"
    source: CatalogSource = load(CATALOGS, kind or "snapshot")(path or "", clouds)
    return source.load()


def registry() -> ImageRegistry:
    """The registry client."""
    found: ImageRegistry = load(REGISTRIES, "distribution")()
    return found


def deployer(infra: str) -> Deployer:
    """What keeps tasks running there: this host for `local`, else SkyPilot."""
    found: Deployer = load(DEPLOYERS, "skypilot" if cloud_of(infra).on_skypilot else "local")()
    return found


def runner(name: str) -> Any:
    """The runner's class."""
    return load(RUNNERS, name)
