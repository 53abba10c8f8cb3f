"""Implement `fogspec join`: join the results of two branches."""

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import note
from fogspec.cli.next_steps import next_command, say_next

if TYPE_CHECKING:
    from fogspec.results.schema import Results

FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("results", type=FILE)
@click.argument("other", type=FILE)
@click.option(
    "--base",
    type=FILE,
    metavar="FILE",
    help="common ancestor of both, as git passes it to a merge driver; no timings are moved",
)
def command(results: Path, other: Path, base: Path | None) -> None:
    """Add the samples of OTHER to RESULTS, two results files of one application, each sample once.

    Raw timings come along from beside OTHER. A machine that both sides measured is measured twice: the second measurement
    becomes a further sample. Results of different inputs are rejected, with what differs.
    """
    from fogspec.base.errors import Refused
    from fogspec.base.layout import Layout
    from fogspec.base.locks import application_lock
    from fogspec.base.project_files import ProjectFiles
    from fogspec.base.text import count, shell_command
    from fogspec.results.io import read_results_file
    from fogspec.results.merge import bring_timings, join_results

    name = read_results_file(results).metadata.name
    with contextlib.ExitStack() as held:
        if base is None and results.parent.absolute().name == "results":
            root = results.parent.parent
            held.enter_context(application_lock(Layout.of(root / "specs" / f"{name}.yaml", name), f"join of {name}"))
        ours, theirs = read_results_file(results), read_results_file(other)
        joined = join_results(ours, theirs, None if base is None else _base(base))
        if base is not None and joined.twice:
            raise Refused(
                f"{name}: both sides measured {', '.join(joined.twice)}: git merges one raw timings file of each",
                "to keep both, take one side and join the file of the other, with its timings beside it:",
                shell_command("fogspec", "join", f"results/{name}.yaml", f"OTHER_CHECKOUT/results/{name}.yaml"),
            )
        final = joined.results if base is not None else bring_timings(joined, results, other)
        if final != ours:
            made = shell_command("fogspec", "join", "RESULTS", "OTHER")
            ProjectFiles(results.parent).write_yaml(results, final.model_dump(mode="json", exclude_none=True), made)
    before, after = len(ours.spec.samples), len(final.spec.samples)
    note(f"{name}: {count(after, 'sample')}, {after - before} more than before")
    for sample in joined.twice:
        note(f"  {sample} was measured by both sides: the other one is {joined.theirs[sample].id} now")
    if base is None:
        say_next(next_command("compile", name))


def _base(path: Path) -> "Results | None":
    """Return the results that both sides began with; git gives an empty file where each side made its own."""
    from fogspec.base.errors import InvalidInput
    from fogspec.base.project_files import ProjectFiles
    from fogspec.results.io import read_results_file

    found = ProjectFiles(path.parent).stat(path)
    if found is None:
        raise InvalidInput(f"{path}: there is no such file")
    return read_results_file(path) if found.st_size else None
