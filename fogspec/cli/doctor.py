"""Implement `fogspec doctor`: what is wrong on this side, before any money is spent."""

from typing import TYPE_CHECKING

import click

from fogspec.base.console import say, say_json
from fogspec.base.layout import Layout
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import CATALOG, OUTPUT, applications_of, complete_application

if TYPE_CHECKING:
    from fogspec.spec.loader import LoadedSpec


@click.command()
@click.argument(
    "spec", required=False, metavar="[APP]", type=click.Path(path_type=str), shell_complete=complete_application
)
@CATALOG
@OUTPUT
def command(spec: str | None, catalog_path: str | None, output: str) -> None:
    """Check the requirements of bench and apply on this computer, before anything is rented.

    APP is a name or a spec, by default all in specs/. Reports ok, problem or not checked, with the fix. No machine is
    started and nothing is written. The registry of a pinned image must have it. For a cloud, SkyPilot checks the access,
    and may start its own API server on this computer. Exits with 1 if there is a problem.
    """
    from fogspec.backends.images.registry import Registry
    from fogspec.backends.registry import deployment_backend
    from fogspec.deploy.doctor import State, as_dict, as_text, checks
    from fogspec.deploy.state import SystemWallClock
    from fogspec.spec.discover import load_specs

    loaded = load_specs() if spec is None else applications_of(spec)
    found = checks(loaded, catalog_path, SystemWallClock(), deployment_backend, Registry().check)
    if output == "json":
        say_json([as_dict(one) for one in found])
    else:
        say(*as_text(found))
        if not any(one.state is State.PROBLEM for one in found):
            say_next(*map(_following, loaded))
    if any(one.state is State.PROBLEM for one in found):
        raise click.exceptions.Exit(1)


def _following(one: "LoadedSpec") -> str | None:
    """Return the command that this computer is ready for: to measure, if there is a plan."""
    layout = Layout.of(one.path, one.application.metadata.name)
    if not layout.files.exists(layout.plan):
        return next_command("compile", one.path)
    return next_command("bench", one.path, "--dry-run")
