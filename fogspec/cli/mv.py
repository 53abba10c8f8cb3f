"""Implement `fogspec mv`: rename an application."""

import click

from fogspec.base.console import note, say
from fogspec.base.errors import UsageError
from fogspec.base.text import shell_command
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import CATALOG, applications_of, complete_application


@click.command()
@click.argument("old", metavar="OLD", shell_complete=complete_application)
@click.argument("new", metavar="NEW")
@CATALOG
def command(old: str, new: str, catalog_path: str | None) -> None:
    """Rename the application OLD, a name or its spec, to NEW: spec, lock, results with raw timings, and compiled files.

    Nothing is measured again. A deployment is bound to the name, so a running application is refused: tear it down first,
    and apply it under its new name.
    """
    from fogspec.base.layout import Layout
    from fogspec.deploy.housekeeping import rename
    from fogspec.deploy.state import SystemWallClock
    from fogspec.spec.discover import applications

    found = applications_of(old)
    if len(found) > 1:
        names = [one.name for one in found]
        raise UsageError(f"{old} has several applications: {', '.join(names)}", "name one of them")
    (one,) = found
    if one.base is not None:
        raise UsageError(
            f"{one.name}: an environment is named by its file", shell_command("git", "mv", one.layout.overlay, "FILE")
        )
    renamed = rename(one, new, applications(), SystemWallClock(), catalog_path)
    say(f"{renamed.before.name} is {renamed.after.name} now, in {renamed.after.spec}")
    note(*(f"{path}: not fogspec's, left there" for path in renamed.stay))
    if one.application.spec.connectivity.link != "none":
        note(f"on the robot, its key of the link is under the old name: {shell_command('fogspec', 'keys', new)}")
    manifest = Layout.of(renamed.after.spec, new).manifest
    todo = [
        shell_command("git", "add", "-A"),
        *([next_command("apply", manifest)] if manifest.exists() else []),
    ]
    say_next(", review, then ".join(filter(None, todo)))
