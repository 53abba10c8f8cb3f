"""Implement `fogspec keys`: make the key of the robot's end of the link."""

import click

from fogspec.base.console import note, say
from fogspec.cli.options import complete_application


@click.command()
@click.argument(
    "specs",
    nargs=-1,
    required=True,
    metavar="APP...",
    type=click.Path(path_type=str),
    shell_complete=complete_application,
)
def command(specs: tuple[str, ...]) -> None:
    """Make the robot's private keys of the links, once, and print their public halves.

    Each APP is a name or a spec. The private halves stay on this computer, in ~/.fogspec/links, readable by you alone.
    """
    from fogspec.deploy.link import folder_of, make_keys
    from fogspec.spec.discover import load_specs

    for one in load_specs(specs):
        name = one.name
        public = make_keys(one.application, one.layout)
        say(f"{name}: {public}")
        note(f"{name}: the private key is in {folder_of(name)} and stays there")
