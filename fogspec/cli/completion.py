"""Implement `fogspec completion`: print a completion script for a shell."""

import click
from click.shell_completion import get_completion_class

from fogspec.base.console import say_text
from fogspec.base.errors import UsageError


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def command(context: click.Context, shell: str) -> None:
    """Print a script for SHELL that completes commands, options, applications, fields and error codes."""
    kind = get_completion_class(shell)
    if kind is None:
        raise UsageError(f"there is no completion for {shell}", "shells: bash, zsh, fish")
    say_text(kind(context.find_root().command, {}, "fogspec", "_FOGSPEC_COMPLETE").source())
