"""Implement `fogspec adopt`: take over what runs and is in no live state."""

from typing import TYPE_CHECKING

import click

from fogspec.base.console import say, say_json, say_on
from fogspec.cli.next_steps import next_command, next_lines
from fogspec.cli.options import CATALOG, OUTPUT, complete_application, open_manifest

if TYPE_CHECKING:
    from fogspec.base.layout import Layout
    from fogspec.deploy.adopt import Adopted
    from fogspec.deploy.preflight import LaunchPlan


@click.command()
@click.argument("applications", nargs=-1, metavar="[APP]...", shell_complete=complete_application)
@CATALOG
@OUTPUT
def command(applications: tuple[str, ...], catalog_path: str | None, output: str) -> None:
    """Record in the live state what runs, where that record is lost; start and end nothing.

    Each APP is a name or a spec, by default all in specs/. Machines are found by name and labels: those of this
    repository's application, wherever they were started. Their manifest must be on disk or committed, and their nodes must
    answer. Then status, apply and down include them again.
    """
    from fogspec.base.errors import UsageError
    from fogspec.base.quantities import as_numbers
    from fogspec.deploy.adopt import check_all
    from fogspec.deploy.down import layout_of
    from fogspec.spec.discover import applications as in_specs

    names = applications or tuple(in_specs())
    if not names:
        raise UsageError("there is no application in specs/ here", "name one: fogspec adopt NAME")
    layouts = [layout_of(name) for name in names]
    found = [_adopted(layout, catalog_path) for layout in layouts]
    if output == "json":
        say_json(
            [
                {
                    "name": layout.name,
                    "adopted": [as_numbers(machine) for machine in one.machines],
                    "serves": one.serves,
                    "left": list(one.left),
                }
                for layout, one in zip(layouts, found, strict=True)
            ]
        )
    else:
        for layout, one in zip(layouts, found, strict=True):
            say(*_as_text(layout, one))
    check_all([f"{layout.name}: {text}" for layout, one in zip(layouts, found, strict=True) for text in one.left])


def _adopted(layout: "Layout", catalog: str | None) -> "Adopted":
    from functools import partial

    from fogspec.backends.registry import deployment_backend
    from fogspec.deploy.adopt import adopt
    from fogspec.deploy.engines import engines_of
    from fogspec.deploy.state import SystemWallClock

    makers = [partial(deployment_backend, infra) for infra in engines_of(layout).infra]
    return adopt(layout, _planned(layout, catalog), makers, SystemWallClock(), say_on)


def _as_text(layout: "Layout", found: "Adopted") -> list[str]:
    from fogspec.deploy.adopt import UNKNOWN_RUNS

    if not (found.machines or found.left):
        return [f"{layout.name}: nothing runs that is not in its live state"]
    lines = []
    for one in found.machines:
        what = f"{one.machine.instance} in {one.machine.infra}, at {one.address}"
        change = "apply has nothing to do" if one.name == found.serves else "apply replaces it"
        if one.runs == UNKNOWN_RUNS:
            change = "what it was given is unknown: apply replaces it"
        lines.append(f"{layout.name}: {one.name} taken over, {what}; {change}")
    return lines + next_lines([next_command("status", layout.argument)] if found.machines else [])


def _planned(layout: "Layout", catalog: str | None) -> "LaunchPlan | None":
    """Return what apply would start now; None if it would refuse."""
    from fogspec.backends.images.registry import Registry
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.base.errors import FogspecError
    from fogspec.deploy.preflight import launch_plan

    try:
        opened = open_manifest(str(layout.manifest), catalog)
        return launch_plan(opened, opened.inputs.catalog, None, False, Registry().digest)
    except (DiagnosticError, FogspecError):
        return None
