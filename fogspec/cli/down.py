"""Implement `fogspec down`: tear down an application."""

from functools import partial
from typing import TYPE_CHECKING

import click

from fogspec.base.console import say, say_json, say_on
from fogspec.cli.options import OUTPUT

if TYPE_CHECKING:
    from collections.abc import Callable

    from fogspec.backends.protocol import DeploymentBackend
    from fogspec.base.layout import Layout


@click.command()
@click.argument("spec_or_name")
@OUTPUT
def command(spec_or_name: str, output: str) -> None:
    """End what runs of one application, by name, and verify that nothing is left.

    That is what was applied, what an apply that was killed had started, and machines of a bench that died, here or
    elsewhere. Idempotent; other applications are not touched.
    """
    from fogspec.deploy.down import down, layout_of, leave_link
    from fogspec.deploy.state import SystemWallClock

    layout = layout_of(spec_or_name)
    count, spent_usd = down(layout, _backends(layout), SystemWallClock(), say_on)
    leave_link(layout)
    if output == "json":
        say_json({"name": layout.name, "ended": count, "spent_usd": round(spent_usd, 6), "left": []}, indent=None)
        return
    from fogspec.base.units import dollars

    ended = "nothing runs" if not count else f"{count} ended, {dollars(spent_usd)} spent; nothing is left"
    say(f"{layout.name}: {ended}")


def _backends(layout: "Layout") -> "list[Callable[[], DeploymentBackend]]":
    from fogspec.backends.registry import deployment_backend
    from fogspec.deploy.engines import engines_of

    engines = engines_of(layout)
    if engines.doubts:
        say_on(*engines.doubts, "so SkyPilot is asked too, besides this host: a record may name a cloud")
    return [partial(deployment_backend, infra) for infra in engines.infra]
