"""`fogspec status`: which stage is fresh, which is stale and why, and what was spent."""

import json

import click

from fogspec.base.outcomes import Differs
from fogspec.cli.options import CATALOG, OUTPUT, catalogs_for


@click.command()
@click.argument("specs", nargs=-1, type=click.Path(path_type=str))
@CATALOG
@OUTPUT
@click.option("--exit-code", is_flag=True, help="exit 3 when a stage is not fresh, or what runs is not well")
def command(specs: tuple[str, ...], catalog_path: str | None, output: str, exit_code: bool) -> None:
    """Say how things stand, from spec to what runs. SPECS are those in specs/; nothing is written.

    What runs is told in two words: sync (Synced, OutOfSync: is it what the manifest says) and health (Healthy, Drifted,
    Degraded, Progressing, Missing, Unknown: do its nodes answer, as fast as the model predicted).
    """
    from fogspec import wiring
    from fogspec.effects.compiler.staleness import status
    from fogspec.effects.deployment import living, telling
    from fogspec.effects.deployment.livestate import SystemTimes
    from fogspec.effects.disk.finding import find_specs
    from fogspec.effects.disk.specfiles import load

    loaded = load(find_specs(specs))
    found = [
        status(one.application, one.path, catalog)
        for one, catalog in zip(loaded, catalogs_for(loaded, catalog_path), strict=True)
    ]
    lives = [
        living.running(loaded_one.application, one.layout, one.fresh, SystemTimes(), wiring.deployer)
        for loaded_one, one in zip(loaded, found, strict=True)
    ]
    if output == "json":
        facts = [
            {**telling.facts(one), "deployment": None if live is None else living.facts(live)}
            for one, live in zip(found, lives, strict=True)
        ]
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        told = [telling.words(one, living.words(live) if live else ()) for one, live in zip(found, lives, strict=True)]
        click.echo("\n\n".join(told))
    others = [
        one.layout.name
        for one, live in zip(found, lives, strict=True)
        if not (one.fresh and (live is None or live.well))
    ]
    if exit_code and others:
        raise Differs(f"not everything is fresh and as predicted: {', '.join(others)}")
