"""Implement `fogspec review`: describe the deployment changes of a pull request."""

import json
from pathlib import Path

import click

from fogspec.base.console import say_text
from fogspec.base.errors import OutOfDate
from fogspec.base.text import json_text
from fogspec.cli.options import CATALOG, POLICIES, SPECS, WORKERS


@click.command()
@click.argument("range_", metavar="BASE[..HEAD]", required=False, default="HEAD")
@SPECS
@CATALOG
@POLICIES
@WORKERS
@click.option(
    "-o",
    "--output",
    type=click.Choice(["markdown", "json"]),
    default="markdown",
    help="output format",
)
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="output file  [default: stdout]")
@click.option(
    "--picture-base", metavar="URL", help="URL below which the files of this commit are published, for links to charts"
)
@click.option("--exit-code", is_flag=True, help="exit 3 if a committed file does not follow from its inputs")
def command(
    range_: str,
    specs: tuple[str, ...],
    catalog_path: str | None,
    policies: tuple[str, ...],
    output: str,
    workers: int | None,
    out: Path | None,
    picture_base: str | None,
    exit_code: bool,
) -> None:
    """Write Markdown about every manifest that differs between BASE and the checkout.

    Each APP is a name or a spec, by default all in specs/. The choice, what all machines cost before and after, which
    inputs changed, whether a machine is replaced, what must be measured first, policies, provenance, and whether everything
    is up to date. At most 65,536 characters, GitHub's limit.

    Exit code 1 for an invalid spec, damaged results or a policy violation, after everything is written.
    """
    from fogspec.audit.comment import markdown
    from fogspec.audit.git import Repository
    from fogspec.audit.review import Base, Reviewer, Whole, as_dict, removed
    from fogspec.audit.shared_work import share
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.base.project_files import write_output
    from fogspec.spec.discover import NoSpecs, check_specs

    repository = Repository()
    base = Base.of(repository, repository.base_of(range_))
    try:
        loaded, said = check_specs(specs)
    except NoSpecs:
        if not removed(repository, base.commit, (), whole=not specs):
            raise
        loaded, said = [], []  # the change removes the last of them
    invalid = [one for one in said if one.severity == "error"]
    reviewer = Reviewer(base, catalog_path, policies)
    reviews = share(reviewer.reviews, loaded, workers)
    # Which applications an invalid spec has is not known, so that none is said to be removed.
    gone = [] if invalid else removed(repository, base.commit, [one.name for one in reviews], whole=not specs)
    whole = Whole(base.commit, reviews, gone, invalid)
    if output == "json":
        text = json_text(json.dumps(as_dict(whole), indent=2, ensure_ascii=False)) + "\n"
    else:
        text = markdown(whole, picture_base)
    if out is None:
        say_text(text, end="")
    else:
        write_output(out, text.encode())
    broken = [found for one in reviews for found in one.broken]
    if wrong := [*invalid, *broken, *dict.fromkeys(found for one in reviews for found in one.unusable)]:
        raise DiagnosticError(wrong)
    if exit_code and (stale := [one.name for one in reviews if not one.fresh]):
        raise OutOfDate(f"not fresh: {', '.join(stale)}", "fogspec status says why")
