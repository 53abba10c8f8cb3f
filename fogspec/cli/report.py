"""`fogspec report`: one self-contained page of an application."""

import shlex
from pathlib import Path

import click

from fogspec.base.errors import UsageError
from fogspec.cli.options import CATALOG, PRIORS, applications_of, catalogs_for, library_from


@click.command()
@click.argument("what", metavar="APP")
@click.option("--name", help="the application, where the spec has several")
@click.option("--to", "to", metavar="FILE", help="where to write it, - for stdout; otherwise compiled/NAME/report.html")
@CATALOG
@PRIORS
def command(what: str, name: str | None, to: str | None, catalog_path: str | None, priors: Path | None) -> None:
    """Write the report of APP, the name of an application in specs/ or a spec.

    The page has spec, funnel, samples, models, a menu that can be weighed anew, costs and provenance. It needs no network.
    """
    from fogspec.base.files import write_bytes
    from fogspec.compile.compiler import compile_application
    from fogspec.report.html import page

    loaded = applications_of(what, name)
    if to is not None and len(loaded) > 1:
        raise UsageError(f"{what} has {len(loaded)} applications, {to} holds one: choose with --name")
    catalogs, library = catalogs_for(loaded, catalog_path), library_from(priors)
    given = [*(["--catalog", catalog_path] if catalog_path else []), *(["--priors", str(priors)] if priors else [])]
    for one, catalog in zip(loaded, catalogs, strict=True):
        compiled = compile_application(one.application, one.path, catalog, library)
        source = compiled.layout.relative(compiled.layout.spec)
        common = shlex.join([source, "--name", compiled.layout.name, *given])
        content = page(
            compiled, Path(one.path).read_text(encoding="utf-8"), f"fogspec report {common}", f"fogspec menu {common}"
        )
        if to == "-":
            click.echo(content, nl=False)
        else:
            target = compiled.layout.page if to is None else Path(to)
            write_bytes(target, content)
            click.echo(f"{target}: {len(content) / 1000:,.0f} kB")
