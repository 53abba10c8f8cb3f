"""Implement `fogspec validate`: report all errors in all specs."""

from functools import partial
from typing import TYPE_CHECKING

import click

from fogspec.base.console import say
from fogspec.base.text import count
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import COLOR, OVERLAYS, POLICIES

if TYPE_CHECKING:
    from fogspec.catalog.table import Catalog
    from fogspec.spec.loader import LoadedSpec


@click.command()
@click.argument("files", nargs=-1)
@OVERLAYS
@click.option(
    "-o",
    "--output",
    type=click.Choice(["text", "json", "github"]),
    default="text",
    help="output format",
)
@POLICIES
@COLOR
def command(
    files: tuple[str, ...], overlays: tuple[str, ...], output: str, policies: tuple[str, ...], color: bool | None
) -> None:
    """Check FILES, or the specs in folders, or those that patterns match; without any, those in specs/."""
    from fogspec.catalog.names import unknown_names
    from fogspec.report.diagnostics import show_diagnostics
    from fogspec.spec.discover import check_specs, find_specs
    from fogspec.spec.rules.benchmark import PLACEHOLDERS
    from fogspec.spec.rules.policies import Policies

    paths = find_specs(files)
    loaded, diagnostics = check_specs(files, overlays)
    absent = dict.fromkeys(error for one in loaded for error in one.absent())
    strange = [said for one in loaded for said in unknown_names(one, partial(_catalog, one))]
    diagnostics = [*diagnostics, *absent, *strange, *Policies(policies).check_specs(loaded)]
    show_diagnostics(diagnostics, output, color)
    if any(one.severity == "error" for one in diagnostics):
        raise click.exceptions.Exit(1)
    if output == "text":
        names = ", ".join(one.name for one in loaded[:10])
        more = f" and {len(loaded) - 10} more" if len(loaded) > 10 else ""
        say(f"{count(len(loaded), 'application')} in {count(len(paths), 'file')} valid: {names}{more}")
        if not any(one.code == PLACEHOLDERS for one in diagnostics):
            say_next(next_command("compile", *files))


def _catalog(one: "LoadedSpec") -> "Catalog | None":
    from fogspec.compile.inputs import catalog_beside_snapshot

    return catalog_beside_snapshot(one)
