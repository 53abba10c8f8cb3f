"""Implement `fogspec logs`: what an application's nodes print."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

from fogspec.base.console import note, say_text
from fogspec.cli.options import complete_application

if TYPE_CHECKING:
    from fogspec.base.layout import Layout


def complete_node(context: click.Context, _parameter: click.Parameter, begun: str) -> list[CompletionItem]:
    """Return the cloud nodes of the application that is named before, for shell completion."""
    from fogspec.base.errors import FogspecError
    from fogspec.deploy.down import layout_of
    from fogspec.deploy.running import names_of_nodes

    # An option whose value is not there yet ends click's parsing: what stood before it is still in `args`.
    app = context.params.get("spec_or_name") or next(iter(context.args), "")
    try:
        names = names_of_nodes(layout_of(str(app)))
    except FogspecError:
        return []
    return [CompletionItem(one) for one in names if one.startswith(begun)]


@click.command()
@click.argument("spec_or_name", metavar="APP", shell_complete=complete_application)
@click.option("-f", "--follow", is_flag=True, help="continue to print new output, until the nodes end")
@click.option("--node", metavar="NODE", help="print only the output of this node", shell_complete=complete_node)
def command(spec_or_name: str, follow: bool, node: str | None) -> None:
    """Print the last output of an application's nodes, without the values of its secrets.

    APP is a name or a spec. Each line begins with the name of its node. If nothing runs, prints the last output of a start
    that failed.
    """
    from functools import cache

    from fogspec.backends.registry import deployment_backend
    from fogspec.deploy.down import layout_of
    from fogspec.deploy.running import followed, log_lines
    from fogspec.deploy.state import SystemWallClock

    layout, times, backend_for = layout_of(spec_or_name), SystemWallClock(), cache(deployment_backend)
    if follow:
        for number, lines in enumerate(followed(layout, times, backend_for)):
            _print(lines, layout, node, checked=number == 0)
        return
    machine, lines = log_lines(layout, times, backend_for)
    if machine is None:
        note(f"{layout.name}: nothing runs; these are the last words of a start that never got ready")
    elif layout.files.is_file(layout.last_words):
        note(f"{layout.last_words}: the last words of a later start that never got ready")
    _print(lines, layout, node)


def _print(lines: Sequence[str], layout: "Layout", node: str | None, checked: bool = True) -> None:
    """Print lines, or those of a node, or say that there are none; raise UsageError, if `checked`, for an unknown node."""
    from fogspec.base.errors import UsageError
    from fogspec.deploy.running import names_in, names_of_nodes, of_node

    found = list(lines) if node is None else of_node(lines, node)
    if node is not None and checked and not found:
        marks, known = names_in(lines), names_of_nodes(layout)
        if not of_node([f"[{name}] " for name in (*known, *marks)], node):
            raise UsageError(
                f"--node {node}: no cloud node of {layout.name} has this name",
                f"nodes: {', '.join(known or marks) or 'none known'}",
            )
        if lines and not any(of_node(lines, name) for name in known):
            note(
                f"{layout.name}: no line of this log names its node: a version of fogspec before --node started what runs",
                f"see all lines: fogspec logs {layout.name}",
            )
        else:
            note(f"{layout.name}: {node} printed none of the lines that are kept")
    if found:
        say_text("\n".join(found))
    elif checked and node is None:
        note(f"{layout.name}: its nodes printed nothing")
