"""`fogspec diff`: what would change, what that costs, and why."""

import json

import click

from fogspec.base.errors import OutOfDate
from fogspec.cli.options import CATALOG, catalogs_for


@click.command()
@click.argument("specs", nargs=-1, type=click.Path(path_type=str))
@CATALOG
@click.option(
    "-o", "--output", type=click.Choice(["text", "json", "markdown"]), default="text", help="form of the answer"
)
@click.option("--exit-code", is_flag=True, help="exit 3 when anything differs")
def command(specs: tuple[str, ...], catalog_path: str | None, output: str, exit_code: bool) -> None:
    """Compare each manifest with the one that compile would write now, and with what runs. SPECS are those in specs/.

    Field by field, with the difference in cost, which input changed, and whether anything must be measured first.
    Values of secrets are not shown. Nothing is written.
    """
    from fogspec.audit import changes
    from fogspec.audit.diff import difference
    from fogspec.deploy.health import running_changes
    from fogspec.deploy.state import SystemWallClock
    from fogspec.spec.discover import find_specs
    from fogspec.spec.loader import load

    loaded = load(find_specs(specs))
    catalogs = catalogs_for(loaded, catalog_path)
    found = []
    for one, catalog in zip(loaded, catalogs, strict=True):
        differing = difference(one, catalog)
        found.append((differing, running_changes(differing.layout, SystemWallClock(), one.application)))
    if output == "json":
        facts = [changes.as_dict(differing, live) for differing, live in found]
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        show = changes.markdown if output == "markdown" else changes.as_text
        click.echo("\n\n".join(show(differing, live) for differing, live in found))
    if exit_code and (others := [differing.layout.name for differing, live in found if differing.differs or live]):
        raise OutOfDate(f"not what compile would write now, or not what runs: {', '.join(others)}")
