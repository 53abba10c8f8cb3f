"""Options and steps that several verbs share."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from fogspec.catalog import Catalog
    from fogspec.spec import Application

SPECS = click.argument("specs", nargs=-1, required=True, type=click.Path(path_type=str))
SPEC = click.argument("spec", type=click.Path(path_type=str))
OUTPUT = click.option("-o", "--output", type=click.Choice(["text", "json"]), default="text", help="form of the answer")
CATALOG = click.option(
    "--catalog", "catalog_path", type=click.Path(path_type=str), metavar="FILE.csv",
    help="machines and prices in SkyPilot's columns, instead of the bundled snapshot",
)  # fmt: skip


def catalog_for(applications: Sequence["Application"], path: str | None) -> "Catalog":
    """The catalog that the command line asks for."""
    from fogspec import wiring

    clouds = sorted({entry.split("/")[0] for application in applications for entry in application.spec.infra})
    catalog = wiring.catalog(path, clouds)
    if path:
        for note in catalog.about.notes:
            click.echo(f"{path}: {note}", err=True)
    return catalog
