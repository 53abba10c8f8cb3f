"""Implement `fogspec priors`: build machine libraries from measurements of other workloads."""

from pathlib import Path

import click

from fogspec.base.console import say
from fogspec.cli.next_steps import next_command, say_next


@click.group()
def command() -> None:
    """Build a machine library: with one, fewer samples suffice."""


@command.command()
@click.option(
    "--from",
    "source",
    type=click.Path(path_type=Path),
    metavar="FROM",
    help="directory in the suite layout, or a database of sparecores-data  [default: that of the installed sparecores-data]",
)
@click.option("--out", type=click.Path(path_type=Path), default=Path("priors.zip"), show_default=True, metavar="FILE")
def build(source: Path | None, out: Path) -> None:
    """Write a machine library for `--priors`."""
    from fogspec.model.priors import read_priors, read_sparecores, rows_of, sparecores_database, write_priors

    if source is not None and source.is_dir():
        machines, latencies = rows_of(source)
    else:
        machines, latencies = read_sparecores(source or sparecores_database())
    write_priors(out, machines, latencies)
    library = read_priors(out)
    say(f"{out}: {len(library.workloads)} workloads on {len(library.names)} machines, {library.digest}")
    say_next(next_command("compile", "--priors", out))
