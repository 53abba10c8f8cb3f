"""`fogspec status`: which stage is fresh, which is stale and why, and what was spent."""

import json

import click

from fogspec.base.outcomes import Differs
from fogspec.cli.options import CATALOG, OUTPUT, catalogs_for


@click.command()
@click.argument("specs", nargs=-1, type=click.Path(path_type=str))
@CATALOG
@OUTPUT
@click.option("--exit-code", is_flag=True, help="exit 3 when a stage is not fresh")
def command(specs: tuple[str, ...], catalog_path: str | None, output: str, exit_code: bool) -> None:
    """Say how things stand, from spec to manifest. SPECS are those in specs/; nothing is written."""
    from fogspec.effects import telling
    from fogspec.effects.finding import find_specs
    from fogspec.effects.specfiles import load
    from fogspec.effects.staleness import status

    loaded = load(find_specs(specs))
    found = [
        status(one.application, one.path, catalog)
        for one, catalog in zip(loaded, catalogs_for(loaded, catalog_path), strict=True)
    ]
    if output == "json":
        click.echo(json.dumps([telling.facts(one) for one in found], indent=2, ensure_ascii=False))
    else:
        click.echo("\n\n".join(map(telling.words, found)))
    if exit_code and (others := [one.layout.name for one in found if not one.fresh]):
        raise Differs(f"not everything is fresh: {', '.join(others)}")
