"""Implement `fogspec logs`: what an application's nodes print."""

import click

from fogspec.base.console import note, say_text
from fogspec.cli.options import complete_application


@click.command()
@click.argument("spec_or_name", metavar="APP", shell_complete=complete_application)
@click.option("-f", "--follow", is_flag=True, help="go on with what is printed, until the nodes end")
def command(spec_or_name: str, follow: bool) -> None:
    """Print the end of what the nodes of one application printed, without the values of its secrets.

    Where nothing runs, the last words of a start that never got ready.
    """
    from functools import cache

    from fogspec.backends.registry import deployment_backend
    from fogspec.deploy.down import layout_of
    from fogspec.deploy.running import followed, log_lines
    from fogspec.deploy.state import SystemWallClock

    layout, times, backend_for = layout_of(spec_or_name), SystemWallClock(), cache(deployment_backend)
    if follow:
        for lines in followed(layout, times, backend_for):
            if lines:
                say_text("\n".join(lines))
        return
    machine, lines = log_lines(layout, times, backend_for)
    if machine is None:
        note(f"{layout.name}: nothing runs; these are the last words of a start that never got ready")
    elif layout.files.is_file(layout.last_words):
        note(f"{layout.last_words}: the last words of a later start that never got ready")
    if lines:
        say_text("\n".join(lines))
