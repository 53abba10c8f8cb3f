"""Implement `fogspec merge-driver`: compile a file in place of merging it."""

import os
from pathlib import Path

import click

from fogspec.base.console import say
from fogspec.base.errors import FogspecError, OutOfDate


@click.command()
@click.argument("ours", metavar="%A", type=click.Path(path_type=Path))
@click.argument("path", metavar="%P")
def command(ours: Path, path: str) -> None:
    """Write what compile makes of the merged specs and results into the file %A; git calls this for a file below compiled/.

    Register it once in each clone: git config merge.fogspec.driver 'fogspec merge-driver %A %P'

    Exit code 3, with our side in the file, where specs or results conflict: git then reports a conflict.
    """
    from fogspec.audit.merge import again, merged, other_side
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.base.project_files import write_output

    try:
        content = merged(path, other_side(os.environ))
    except FogspecError as failed:
        raise OutOfDate(f"{path}: cannot be compiled in this merge: {failed.message}", again(path)) from None
    except DiagnosticError as damaged:
        raise OutOfDate(
            f"{path}: cannot be compiled in this merge: {damaged.diagnostics[0].message}", again(path)
        ) from None
    write_output(ours, content)
    say(f"{path}: compiled from what is merged", err=True)
