"""`fogspec migrate`: bring specs to the newest apiVersion."""

import click

from fogspec.base.errors import OutOfDate


@click.command()
@click.argument("files", nargs=-1)
@click.option("--check", is_flag=True, help="write nothing; exit 3 when a file is not at the newest version")
def command(files: tuple[str, ...], check: bool) -> None:
    """Bring FILES, specs in folders or those that patterns match, to the newest apiVersion; comments and order stay."""
    from fogspec.spec.discover import find_specs
    from fogspec.spec.migrate import migrate, write
    from fogspec.spec.schema import API_VERSION

    found = [migrate(path) for path in find_specs(files)]
    old = [one for one in found if one.changed]
    if check and old:
        raise OutOfDate(f"{len(old)} files are not at {API_VERSION}", *(one.path for one in old))
    for one in old:
        write(one)
        click.echo(f"{one.path}: {', '.join(one.versions)}")
    if not old:
        click.echo(f"files at {API_VERSION}, the newest version: {len(found)}; nothing to do")
