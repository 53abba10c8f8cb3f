"""Implement `fogspec diff`: show pending changes, their cost, and their reasons."""

from typing import TYPE_CHECKING

import click

from fogspec.base.console import note, say_json, say_text
from fogspec.base.errors import OutOfDate
from fogspec.cli.next_steps import after_diff, say_next
from fogspec.cli.options import CATALOG, SPECS, load_inputs, raise_damaged

if TYPE_CHECKING:
    from fogspec.base.diagnostics import Diagnostic


@click.command()
@SPECS
@CATALOG
@click.option("-o", "--output", type=click.Choice(["text", "json", "markdown"]), default="text", help="output format")
@click.option("--exit-code", is_flag=True, help="exit 3 if anything differs")
def command(specs: tuple[str, ...], catalog_path: str | None, output: str, exit_code: bool) -> None:
    """Compare each manifest with the one that compile would write now, and with the deployment.

    Each APP is a name or a spec, by default all in specs/. Field by field, with the difference in cost, which input
    changed, and whether anything must be measured first. Values of secrets are not shown. Nothing is written.
    """
    from fogspec.audit import diff
    from fogspec.audit.freshness import look
    from fogspec.base.git import tracked_note
    from fogspec.deploy.health import running_changes
    from fogspec.deploy.state import SystemWallClock
    from fogspec.deploy.stores import StoreUnavailable

    inputs = load_inputs(specs, catalog_path, audit=True, each=True)
    note(*dict.fromkeys(said for one in inputs if (said := tracked_note(one.layout)) is not None))
    found, damaged, away = [], list["Diagnostic"](), None
    for one in inputs:
        known = look(one)
        damaged += known.damaged
        differing = diff.difference(known)
        live = None
        if away is None:
            try:
                live = running_changes(one.layout, SystemWallClock(), one.application, one.sent)
            except StoreUnavailable as lost:
                away = lost
        found.append((differing, live))
    if output == "json":
        data = [diff.as_dict(differing, live) for differing, live in found]
        say_json(data)
    else:
        show = diff.markdown if output == "markdown" else diff.as_text
        say_text("\n\n".join(show(differing, live) for differing, live in found))
        if output == "text":
            say_next(*(after_diff(one, *pair) for one, pair in zip(inputs, found, strict=True)))
    raise_damaged(damaged)
    if away is not None:
        raise away
    if exit_code and (others := [differing.layout.name for differing, live in found if differing.differs or live]):
        raise OutOfDate(f"not what compile would write now, or not what runs: {', '.join(others)}")
