"""Options and steps that several verbs share."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.clouds import cloud_name
from fogspec.base.errors import OutOfDate, UsageError

if TYPE_CHECKING:
    from fogspec.base.layout import Layout
    from fogspec.catalog.table import Catalog
    from fogspec.numerics.priors import Library
    from fogspec.spec.loader import LoadedSpec
    from fogspec.spec.lockfile import Pins

SPECS = click.argument("specs", nargs=-1, type=click.Path(path_type=str))
SPEC = click.argument("spec", type=click.Path(path_type=str))


def _color(_context: click.Context, _parameter: click.Parameter, when: str) -> bool | None:
    return {"always": True, "never": False}.get(when)


COLOR = click.option(
    "--color",
    type=click.Choice(["auto", "always", "never"]),
    default="auto",
    callback=_color,
    help="auto: on a terminal, unless NO_COLOR is set",
)


def _manifest(_context: click.Context, _parameter: click.Parameter, given: str) -> str:
    from fogspec.spec.discover import is_name

    return os.path.join("compiled", given, "manifest.yaml") if is_name(given) else given


MANIFEST = click.argument("manifest", type=click.Path(path_type=str), callback=_manifest)
OUTPUT = click.option("-o", "--output", type=click.Choice(["text", "json"]), default="text", help="form of the answer")
CATALOG = click.option(
    "--catalog",
    "catalog_path",
    type=click.Path(path_type=str),
    metavar="FROM",
    help="machines and prices: snapshot (bundled), skypilot (SkyPilot's own, as it fetched them), a folder in "
    "SkyPilot's layout, or a CSV file in its columns; otherwise what fogspec.lock says, or the snapshot",
)
POLICIES = click.option(
    "--policy",
    "policies",
    multiple=True,
    metavar="FILE",
    help="a JSON Schema that must be met too, besides policies/*.schema.json next to specs/",
)
PRIORS = click.option(
    "--priors",
    type=click.Path(path_type=Path),
    metavar="DIR|FILE",
    help="a machine library (fogspec priors build): with one, fewer samples suffice; otherwise what fogspec.lock says",
)


def applications_of(what: str, name: str | None = None) -> list["LoadedSpec"]:
    """The applications of a spec, or the one in specs/ that `what` names; `name` picks one where a spec has several.

    Raises UsageError where there is none, Problems where the spec is wrong.
    """
    from fogspec.spec.discover import is_name, spec_of
    from fogspec.spec.loader import load

    path = spec_of(what)
    if path is None and is_name(what) and os.path.isdir("specs"):
        raise UsageError(f"specs/ has no application named {what}", "name its file, such as specs/NAME.yaml")
    wanted = name or (what if path else None)
    found = [one for one in load([path or what]) if wanted in (None, one.application.metadata.name)]
    if not found:
        raise UsageError(f"{path or what} has no application named {wanted}")
    return found


def library_from(path: Path | None) -> "Library | None":
    """The machine library that the command line names; None leaves it to the lock. Raises InvalidInput and DiagnosticError."""
    if path is None:
        return None
    from fogspec.model.priors import read_priors

    return read_priors(path)


def catalogs_for(loaded: Sequence["LoadedSpec"], path: str | None) -> list["Catalog"]:
    """Each application's catalog: what the command line asks for, else what the lock says, else the snapshot.

    Raises OutOfDate when the catalog is no longer the one that was locked, InvalidInput or Problems when it cannot be read.
    Says what was left out of a catalog that was asked for, and that a catalog is older than a spec allows.
    """
    from fogspec.base.layout import Layout
    from fogspec.spec.lock_io import read_pins

    known: dict[tuple[str | None, tuple[str, ...]], Catalog] = {}
    said: dict[str, None] = {}
    found = []
    for one in loaded:
        layout = Layout.of(one.path, one.application.metadata.name)
        pins = read_pins(layout)
        origin = path or (located(pins.catalog.origin, layout) if pins else None)
        key = (origin, clouds_of(one))
        if key not in known:
            known[key] = load_catalog(*key)
        catalog = known[key]
        if pins is not None and path is None:
            catalog = _as_locked(catalog, pins, layout)
        said |= dict.fromkeys([*(f"{path}: {note}" for note in catalog.about.notes if path), *_age(one, catalog)])
        found.append(catalog)
    for line in said:
        click.echo(line, err=True)
    return found


def load_catalog(origin: str | None, clouds: tuple[str, ...]) -> "Catalog":
    """The catalog from there, for these clouds."""
    from fogspec.catalog import sources

    return sources.load_catalog(origin, clouds)


def clouds_of(one: "LoadedSpec") -> tuple[str, ...]:
    """The clouds that a spec names."""
    return tuple(sorted({cloud_name(entry) for entry in one.application.spec.infra}))


def located(origin: str, layout: "Layout") -> str:
    """What `--catalog` would be given for the origin that a lock names."""
    return origin if origin in ("snapshot", "skypilot") else os.path.normpath(layout.root / origin)


def _as_locked(catalog: "Catalog", pins: "Pins", layout: "Layout") -> "Catalog":
    from dataclasses import replace

    pin = pins.catalog
    if catalog.about.digest != pin.digest:
        raise OutOfDate(
            f"{layout.name}: the catalog {pin.origin} is not the one that {layout.lock} pins",
            f"fogspec lock {layout.spec} --upgrade catalog",
        )
    about = replace(catalog.about, source=pin.source, revision=pin.revision, date=pin.date)
    return replace(catalog, about=about)


def _age(one: "LoadedSpec", catalog: "Catalog") -> list[str]:
    """That the catalog is older than the spec allows."""
    from datetime import UTC, date, datetime

    dated, most_s = catalog.about.date, one.application.spec.catalog.max_age
    if not dated:
        return []
    days = (datetime.now(UTC).date() - date.fromisoformat(dated)).days
    if days * 86400 <= most_s:
        return []
    return [
        f"warning: {catalog.about.source}: prices are of {dated}, {days} days old; spec.catalog.max_age allows "
        f"{most_s / 86400:g}: see --catalog"
    ]
