"""Implement `fogspec validate`: report all errors in all specs, and print them as they are read."""

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import click

from fogspec.base.console import say, say_text
from fogspec.base.text import count
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import COLOR, POLICIES

if TYPE_CHECKING:
    from fogspec.catalog.table import Catalog
    from fogspec.language.loader import LoadedSpec


@click.command()
@click.argument("files", nargs=-1)
@click.option(
    "-o",
    "--output",
    type=click.Choice(["text", "json", "github", "yaml"]),
    default="text",
    help="output format",
)
@POLICIES
@COLOR
def command(files: tuple[str, ...], output: str, policies: tuple[str, ...], color: bool | None) -> None:
    """Check FILES, or the specs in folders, or those that patterns match; without any, those in specs/.

    -o yaml prints valid specs as fogspec reads them: with every default, and behind each value its source line, or
    "default". NAME@ENVIRONMENT is an application in an environment. Mappings merge, lists whose items have names merge by
    name, other lists replace; null removes a value.
    """
    from fogspec.catalog.names import unknown_names
    from fogspec.language.discover import check_specs, find_specs
    from fogspec.language.documents import Reading
    from fogspec.language.rules.benchmark import PLACEHOLDERS
    from fogspec.language.rules.policies import Policies
    from fogspec.report.diagnostics import show_diagnostics

    reading = Reading()
    paths = find_specs(files, reading)
    loaded, diagnostics = check_specs(files, reading)
    absent = dict.fromkeys(error for one in loaded for error in one.absent())
    strange = [said for one in loaded for said in unknown_names(one, partial(_catalog, one))]
    diagnostics = [*diagnostics, *absent, *strange, *Policies(policies).check_specs(loaded)]
    show_diagnostics(diagnostics, output, color)
    if any(one.severity == "error" for one in diagnostics):
        raise click.exceptions.Exit(1)
    if output == "yaml":
        shown = [one for one in loaded if one.base is None or one.name in files]
        say_text("\n---\n".join("\n".join(_as_yaml(one)) for one in shown))
    if output == "text":
        names = ", ".join(one.name for one in loaded[:10])
        more = f" and {len(loaded) - 10} more" if len(loaded) > 10 else ""
        say(f"{count(len(loaded), 'application')} in {count(len(paths), 'file')} valid: {names}{more}")
        if not any(one.code == PLACEHOLDERS for one in diagnostics):
            say_next(next_command("compile", *files))


def _catalog(one: "LoadedSpec") -> "Catalog | None":
    from fogspec.compile.inputs import catalog_beside_snapshot

    return catalog_beside_snapshot(one)


def _as_yaml(loaded: "LoadedSpec") -> Iterator[str]:
    """Yield the lines of the spec in full, each value with its origin."""
    from fogspec.base.yaml.positions import find
    from fogspec.base.yaml.writer import block
    from fogspec.language.render import render_document

    lines = list(block(render_document(loaded.application)))
    width = min(60, max(len(line) for line, _ in lines))
    spans = loaded.spans
    for line, path in lines:
        if line.endswith(":"):
            yield line
            continue
        known = find(loaded.node, path) is not None
        origin = f"{spans[path].path}:{spans[path].line}" if known else "default"
        yield f"{line:<{width}}  # {origin}"
