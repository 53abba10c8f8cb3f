"""Implement `fogspec-lab library`: build machine libraries from measurements of other workloads."""

import gzip
from pathlib import Path

import click

from fogspec.base.console import say


@click.command()
@click.option(
    "--from",
    "suite",
    type=click.Path(path_type=Path),
    metavar="DIR",
    required=True,
    help="directory in the suite layout",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("library.json.gz"),
    show_default=True,
    metavar="FILE",
    help="file to write",
)
def command(suite: Path, out: Path) -> None:
    """Build a machine library for `spec.library`, in place of the one that fogspec brings."""
    from fogspec.base.project_files import write_output
    from fogspec.model.library import read_library
    from fogspec_lab.libraries import library_file

    content = library_file(suite)
    write_output(out, gzip.compress(content, 9, mtime=0) if out.suffix == ".gz" else content)
    library = read_library(out)
    say(f"{out}: {len(library.workloads)} workloads on {len(library.names)} machines, {library.digest}")
    say(f"next: write library: {out} in a spec")
