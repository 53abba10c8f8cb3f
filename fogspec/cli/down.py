"""Implement `fogspec down`: tear down an application."""

import sys
from functools import partial
from typing import TYPE_CHECKING

import click

from fogspec.base.console import ask, say, say_json, say_on
from fogspec.base.errors import Refused, UsageError
from fogspec.cli.options import OUTPUT, complete_application

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fogspec.backends.naming import Owner
    from fogspec.backends.protocol import DeploymentBackend
    from fogspec.base.layout import Layout


@click.command()
@click.argument("spec_or_name", metavar="APP", shell_complete=complete_application)
@click.option(
    "--repository",
    metavar="URL",
    help="tear down machines that another repository started for the application, such as a fork or a former origin",
)
@click.option(
    "--yes", is_flag=True, help="skip the confirmation prompt, which appears only on a terminal or with --repository"
)
@OUTPUT
def command(spec_or_name: str, repository: str | None, yes: bool, output: str) -> None:
    """Tear down one application, by name, and verify that nothing is left.

    APP is a name or a spec. Terminates the deployment, what an interrupted apply had started, and machines of a bench that
    died, here or elsewhere. Idempotent. Other applications, and machines of other repositories without --repository, are
    not touched.
    """
    from fogspec.deploy.down import down, layout_of, leave_link
    from fogspec.deploy.state import SystemWallClock

    layout = layout_of(spec_or_name)
    owner = None if repository is None else _owner(layout, repository)
    asks = not yes and (repository is not None or sys.stdin.isatty())
    confirm = (lambda names: _ask(names, owner)) if asks else None
    count, spent_usd = down(layout, _backends(layout), SystemWallClock(), say_on, confirm, owner)
    if owner is None:
        leave_link(layout)
    if output == "json":
        say_json({"name": layout.name, "ended": count, "spent_usd": round(spent_usd, 6), "left": []}, indent=None)
        return
    from fogspec.base.units import dollars

    ended = "nothing runs" if not count else f"{count} ended, {dollars(spent_usd)} spent; nothing is left"
    say(f"{layout.name}: {ended}")


def _owner(layout: "Layout", url: str) -> "Owner":
    from fogspec.backends.naming import Owner
    from fogspec.base.repository import repository_at

    repository = repository_at(url, layout.root)
    if repository is None:
        raise UsageError("--repository: no URL", "write it as git remote get-url origin prints it in its clone")
    return Owner(repository, layout.environment, layout.application)


def _ask(names: "Sequence[str]", owner: "Owner | None") -> None:
    whose = "" if owner is None else f" of {owner}"
    say_on(f"{len(names)} {'machine' if len(names) == 1 else 'machines'}{whose}:", *(f"  {name}" for name in names))
    if not sys.stdin.isatty():
        raise Refused("confirmation required, and no terminal is attached", "pass --yes to end these machines")
    if not ask("end what is listed?"):
        raise Refused("nothing was ended")


def _backends(layout: "Layout") -> "list[Callable[[], DeploymentBackend]]":
    from fogspec.backends.registry import deployment_backend
    from fogspec.deploy.engines import engines_of

    engines = engines_of(layout)
    if engines.doubts:
        say_on(*engines.doubts, "so SkyPilot is asked too, besides this host: a record may name a cloud")
    return [partial(deployment_backend, infra) for infra in engines.infra]
