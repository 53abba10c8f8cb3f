"""Implement `fogspec review`: describe the deployment changes of a pull request."""

from pathlib import Path

import click

from fogspec.base.console import say_text
from fogspec.base.errors import InvalidInput, OutOfDate
from fogspec.cli.options import CATALOG, POLICIES, check_policies, load_inputs


@click.command()
@click.argument("range_", metavar="BASE[..HEAD]", required=False, default="HEAD")
@click.argument("specs", nargs=-1, type=click.Path(path_type=str))
@CATALOG
@POLICIES
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="write it there; otherwise to the output")
@click.option(
    "--picture-base", metavar="URL", help="where the files of this commit can be seen: pictures are linked there"
)
@click.option("--exit-code", is_flag=True, help="exit 3 when something committed does not follow from its inputs")
def command(
    range_: str,
    specs: tuple[str, ...],
    catalog_path: str | None,
    policies: tuple[str, ...],
    out: Path | None,
    picture_base: str | None,
    exit_code: bool,
) -> None:
    """Write Markdown about every manifest that differs between BASE and what is checked out. SPECS are those in specs/.

    The choice, what it costs before and after, which inputs changed, provenance, and whether everything is fresh.
    """
    from fogspec.audit.freshness import status
    from fogspec.audit.git import Repository
    from fogspec.audit.review import markdown, removed, review
    from fogspec.base.project_files import write_output
    from fogspec.compile.compiler import try_compile
    from fogspec.spec.discover import find_specs

    repository = Repository()
    commit = repository.base_of(range_)
    try:
        inputs = load_inputs(find_specs(specs), catalog_path, audit=True)
    except InvalidInput:
        if not removed(repository, commit, ()):
            raise
        inputs = []  # the change removes the last of them
    reviews = [review(status(one, try_compile(one)), repository, commit) for one in inputs]
    gone = removed(repository, commit, [one.layout.name for one in inputs])
    text = markdown(reviews, gone, picture_base)
    if out is None:
        say_text(text, end="")
    else:
        write_output(out, text.encode())
    check_policies(policies, inputs)
    if exit_code and (stale := [one.difference.layout.name for one in reviews if not one.fresh]):
        raise OutOfDate(f"not fresh: {', '.join(stale)}", "fogspec status says why")
