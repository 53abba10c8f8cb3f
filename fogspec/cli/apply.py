"""Implement `fogspec apply`: deploy a manifest."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import ask, say, say_json, say_on
from fogspec.base.errors import Refused
from fogspec.base.text import shell_command
from fogspec.base.units import parse_price_usd_per_hour
from fogspec.cli.next_steps import next_command, same_command, say_next
from fogspec.cli.options import (
    MANIFEST,
    OUTPUT,
    POLICIES,
    check_image,
    check_policies,
    open_manifest,
    quantity,
    unmet,
)

if TYPE_CHECKING:
    from fogspec.base.layout import Layout
    from fogspec.catalog.table import Catalog
    from fogspec.compile.bundle import ManifestBundle
    from fogspec.deploy.adopt import Adopted
    from fogspec.deploy.preflight import LaunchPlan


@click.command()
@MANIFEST
@POLICIES
@click.option(
    "--prices",
    metavar="FROM",
    help="price catalog of the price check, as compile --catalog  [default: that of the plan]",
)
@click.option("--max", "most", metavar="'$0.60/h'", help="highest price per hour  [default: the approved price]")
@click.option(
    "--resolve-image", is_flag=True, help="pin an image's tag to its current digest, if the manifest does not"
)
@click.option("--older", is_flag=True, help="accept a commit that is older than the one that runs, or may be")
@click.option("--adopt", is_flag=True, help="record what runs already, where its record is lost; start and end nothing")
@click.option("--dry-run", is_flag=True, help="check what it requires, show what would run and what it costs, and stop")
@click.option("--yes", is_flag=True, help="skip the confirmation prompt")
@OUTPUT
def command(
    manifest: str,
    policies: tuple[str, ...],
    prices: str | None,
    most: str | None,
    resolve_image: bool,
    older: bool,
    adopt: bool,
    dry_run: bool,
    yes: bool,
    output: str,
) -> None:
    """Launch exactly the task that MANIFEST names, wait until its nodes answer, then end what ran before.

    MANIFEST is a file, or the name of an application: compiled/NAME/manifest.yaml.

    Refuses a manifest that is stale or was edited, a price above the one approved, and in a git repository a commit that is
    an ancestor of the one that runs. In CI, and where clones share the state, a manifest for rented machines must be
    committed at HEAD. Idempotent: what runs already is left alone. Ctrl-C ends what is being started.

    --adopt finds machines of this repository's application by name and labels, wherever they were started. Their manifest
    must be on disk or committed, and their nodes must answer. Then status, apply and down include them again.
    """
    if adopt:
        _take_over(manifest, dry_run, output)
        return
    from fogspec.backends.images.registry import Registry
    from fogspec.backends.registry import deployment_backend
    from fogspec.base.clouds import LOCAL
    from fogspec.deploy.apply import apply
    from fogspec.deploy.checks import Stage
    from fogspec.deploy.preflight import applied, as_text, check_fresh, launch_plan
    from fogspec.deploy.state import DeploymentState, SystemWallClock

    opened = open_manifest(manifest)
    check_policies(policies, [opened.inputs])
    wanting = False
    if dry_run:
        machines = [one.machine for one in (opened.manifest.spec, *opened.manifest.spec.fallbacks)]
        here = machines[0] if machines[0].infra == LOCAL else None
        wanting = unmet([opened.loaded], Stage.APPLY, [one.infra for one in machines], output, opened.inputs, here=here)
    check_fresh(opened)
    ordered = launch_plan(opened, _prices(opened, prices), _price(most), resolve_image, Registry().digest)
    say(*as_text(ordered), err=True)
    times = SystemWallClock()
    if dry_run:
        applied(opened, DeploymentState.look(opened.layout, times), older)
        if wanting:
            raise click.exceptions.Exit(1)
        if output == "text":
            say_next(same_command(without="dry_run"))
        return

    def approve() -> None:
        check_image(ordered.image, opened.loaded.application.spec, measures=False)
        _ask(yes)

    done = apply(ordered, deployment_backend, times, say_on, approve, lambda live: applied(opened, live, older))
    machine = done.machine
    if output == "json":
        from fogspec.base.quantities import as_numbers

        found = {"changed": done.changed, "waited_s": done.waited_s, **as_numbers(machine)}
        say_json(found, indent=None)
        return
    what = f"{machine.machine.instance} in {machine.machine.infra}, {machine.machine.price_words}"
    if done.kept:
        say(f"{opened.layout.name}: the machine stays, under the new manifest: {what}, at {machine.address}")
    elif done.changed:
        say(f"{opened.layout.name}: runs on {what}, at {machine.address}; answered after {done.waited_s:.1f} s")
        if opened.manifest.pins.robot_launch is not None:
            say(f"on the robot: {shell_command('ros2', 'launch', opened.layout.robot)}")
    else:
        say(f"{opened.layout.name}: no changes; runs on {what}, at {machine.address}")
    say_next(next_command("status", opened.layout.argument))


def _prices(opened: "ManifestBundle", origin: str | None) -> "Catalog":
    from fogspec.catalog.sources import load_catalog
    from fogspec.compile.inputs import clouds_of

    return opened.inputs.catalog if origin is None else load_catalog(origin, clouds_of(opened.loaded))


def _price(text: str | None) -> float | None:
    return None if text is None else quantity("--max", text, parse_price_usd_per_hour)


def _ask(yes: bool) -> None:
    if yes:
        return
    if not sys.stdin.isatty():
        raise Refused("confirmation required, and no terminal is attached", "pass --yes to approve this price")
    if not ask("start it?"):
        raise Refused("nothing was started")


def _take_over(manifest: str, dry_run: bool, output: str) -> None:
    """Record the machines of the application that run and are on no record; raise Refused for those that cannot be."""
    from fogspec.base.errors import UsageError
    from fogspec.base.layout import Layout
    from fogspec.base.quantities import as_numbers

    if dry_run:
        raise UsageError("--adopt and --dry-run exclude each other", "--adopt starts and ends nothing")
    folder = Path(manifest).parent
    layout = Layout.named(folder.parent.parent, folder.name)
    if os.path.abspath(layout.manifest) != os.path.abspath(manifest):
        raise UsageError(f"{manifest}: is not the manifest of an application", "name compiled/NAME/manifest.yaml")
    found = _adopted(layout)
    if output == "json":
        machines = [as_numbers(machine) for machine in found.machines]
        say_json({"name": layout.name, "adopted": machines, "serves": found.serves, "left": list(found.left)})
    else:
        say(*_as_text(layout, found))
        if found.machines:
            say_next(next_command("status", layout.argument))
    if count := len(found.left):
        raise Refused(f"{count} {'machine was' if count == 1 else 'machines were'} not taken over", *found.left)


def _adopted(layout: "Layout") -> "Adopted":
    from functools import partial

    from fogspec.backends.registry import deployment_backend
    from fogspec.base.clouds import LOCAL
    from fogspec.deploy.adopt import adopt
    from fogspec.deploy.engines import engines_of
    from fogspec.deploy.state import SystemWallClock

    engines = engines_of(layout)
    only_here = engines.clouds == {LOCAL}
    if engines.doubts:
        asked = "this host alone is asked: no other record names a cloud" if only_here else "so SkyPilot is asked too"
        say_on(*engines.doubts, asked)
    makers = [partial(deployment_backend, infra) for infra in ([LOCAL] if only_here else engines.infra)]
    return adopt(layout, _planned(layout), makers, SystemWallClock(), say_on)


def _planned(layout: "Layout") -> "LaunchPlan | None":
    """Return what apply would start now; None if it would refuse."""
    from fogspec.backends.images.registry import Registry
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.base.errors import FogspecError
    from fogspec.deploy.preflight import launch_plan

    try:
        opened = open_manifest(str(layout.manifest), layout.spec)
        return launch_plan(opened, opened.inputs.catalog, None, False, Registry().digest)
    except (DiagnosticError, FogspecError):
        return None


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
    return [*lines, f"{layout.name}: nothing was started or ended"]
