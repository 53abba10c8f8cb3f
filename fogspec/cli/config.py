"""Implement `fogspec config`: print a spec with overlays merged and defaults filled in."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import click

from fogspec.base.console import say_json, say_text
from fogspec.cli.options import OUTPUT, OVERLAYS, SPECS

if TYPE_CHECKING:
    from fogspec.spec.loader import LoadedSpec


@click.command()
@SPECS
@OVERLAYS
@click.option("--origins", is_flag=True, help='annotate each value with its source line, or "default"')
@OUTPUT
def command(specs: tuple[str, ...], overlays: tuple[str, ...], origins: bool, output: str) -> None:
    """Print applications as fogspec reads them.

    Each APP is a name or a spec, by default all in specs/. NAME@ENVIRONMENT is an application in an environment. Mappings
    merge, lists whose items have names merge by name, other lists replace; null removes a value.
    """
    from fogspec.spec.discover import load_specs
    from fogspec.spec.render import render_document

    loaded = [one for one in load_specs(specs, overlays) if one.base is None or one.name in specs]
    if output == "json":
        say_json([render_document(one.application) for one in loaded])
    else:
        say_text("\n---\n".join("\n".join(_lines(one, origins)) for one in loaded))


def _lines(loaded: "LoadedSpec", origins: bool) -> Iterator[str]:
    from fogspec.base.yaml.positions import find
    from fogspec.base.yaml.writer import block
    from fogspec.spec.render import render_document

    lines = list(block(render_document(loaded.application)))
    width = min(60, max(len(line) for line, _ in lines))
    spans = loaded.spans
    for line, path in lines:
        if not origins or line.endswith(":"):
            yield line
            continue
        node = find(loaded.node, path)
        origin = f"{spans[path].path}:{spans[path].line}" if node is not None else "default"
        yield f"{line:<{width}}  # {origin}"
