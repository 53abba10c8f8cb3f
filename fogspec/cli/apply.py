"""Implement `fogspec apply`: deploy a manifest."""

import sys
from typing import TYPE_CHECKING

import click

from fogspec.base.console import ask, say, say_json, say_on
from fogspec.base.errors import Refused
from fogspec.base.text import shell_command
from fogspec.base.units import parse_price_usd_per_hour, shown_price
from fogspec.cli.next_steps import next_command, same_command, say_next
from fogspec.cli.options import (
    CATALOG,
    MANIFEST,
    OUTPUT,
    POLICIES,
    check_image,
    check_policies,
    open_manifest,
    quantity,
)

if TYPE_CHECKING:
    from fogspec.catalog.table import Catalog
    from fogspec.compile.bundle import ManifestBundle


@click.command()
@MANIFEST
@CATALOG
@POLICIES
@click.option(
    "--prices", metavar="FROM", help="price catalog of the price check, as --catalog  [default: that of --catalog]"
)
@click.option("--max", "most", metavar="'$0.60/h'", help="highest price per hour  [default: the approved price]")
@click.option(
    "--require-attestation",
    "key",
    type=click.Path(path_type=str),
    metavar="PEM",
    help="refuse without a statement of exactly these files (fogspec attest) that is signed with this public key",
)
@click.option(
    "--attestation",
    type=click.Path(path_type=str),
    metavar="FILE",
    help="the statement  [default: compiled/NAME/attestation.json]",
)
@click.option(
    "--resolve-image", is_flag=True, help="pin an image's tag to its current digest, if the manifest does not"
)
@click.option("--dry-run", is_flag=True, help="show what would run and what it costs, and stop")
@click.option("--yes", is_flag=True, help="skip the confirmation prompt")
@OUTPUT
def command(
    manifest: str,
    catalog_path: str | None,
    policies: tuple[str, ...],
    prices: str | None,
    most: str | None,
    key: str | None,
    attestation: str | None,
    resolve_image: bool,
    dry_run: bool,
    yes: bool,
    output: str,
) -> None:
    """Launch exactly the task that MANIFEST names, wait until its nodes answer, then end what ran before.

    MANIFEST is a file, or the name of an application: compiled/NAME/manifest.yaml.

    Refuses a manifest that is stale or was edited, and a price above the one approved. Idempotent: what runs already
    is left alone. Ctrl-C ends what is being started.
    """
    from fogspec.backends.images.registry import Registry
    from fogspec.backends.registry import deployment_backend
    from fogspec.deploy.apply import apply
    from fogspec.deploy.preflight import as_text, check_fresh, launch_plan
    from fogspec.deploy.state import SystemWallClock

    if attestation is not None and key is None:
        raise click.UsageError("--attestation needs --require-attestation")
    opened = open_manifest(manifest, catalog_path)
    check_policies(policies, [opened.inputs])
    check_fresh(opened)
    if key is not None:
        from fogspec.audit.sign import require_signed

        require_signed(opened, attestation, key)
        say(f"{opened.layout.name}: attested by a statement signed with {key}", err=True)
    ordered = launch_plan(opened, _prices(opened, prices), _price(most), resolve_image, Registry().digest)
    say(*as_text(ordered), err=True)
    if dry_run:
        if output == "text":
            say_next(same_command(without="dry_run"))
        return

    def approve() -> None:
        check_image(ordered.image, opened.loaded.application.spec)
        _ask(yes)

    applied = apply(ordered, deployment_backend, SystemWallClock(), say_on, approve)
    machine = applied.machine
    if output == "json":
        from fogspec.base.quantities import as_numbers

        found = {"changed": applied.changed, "waited_s": applied.waited_s, **as_numbers(machine)}
        say_json(found, indent=None)
        return
    what = f"{machine.machine.instance} in {machine.machine.infra}, {shown_price(machine.machine.price)}"
    if applied.kept:
        say(f"{opened.layout.name}: the machine stays, under the new manifest: {what}, at {machine.address}")
    elif applied.changed:
        say(f"{opened.layout.name}: runs on {what}, at {machine.address}; answered after {applied.waited_s:.1f} s")
        if opened.manifest.spec.robot_launch is not None:
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
