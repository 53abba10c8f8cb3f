"""Implement `fogspec review`: describe the deployment changes of a pull request."""

import json
from pathlib import Path

import click

from fogspec.base.console import say_text
from fogspec.base.errors import InvalidInput, OutOfDate
from fogspec.base.text import json_text
from fogspec.cli.options import CATALOG, POLICIES, SPECS


@click.command()
@click.argument("range_", metavar="BASE[..HEAD]", required=False, default="HEAD")
@SPECS
@CATALOG
@POLICIES
@click.option("-o", "--output", type=click.Choice(["markdown", "json"]), default="markdown", help="form of the answer")
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
    output: str,
    out: Path | None,
    picture_base: str | None,
    exit_code: bool,
) -> None:
    """Write Markdown about every manifest that differs between BASE and what is checked out. SPECS are those in specs/.

    The choice, what all machines cost before and after, which inputs changed, whether a machine is replaced, what must be
    measured first, policies, provenance, and whether everything is fresh. At most 65,536 characters, as GitHub takes them.

    Exit code 1 for an invalid spec or a broken policy, after everything is written.
    """
    from fogspec.audit.comment import markdown
    from fogspec.audit.freshness import status
    from fogspec.audit.git import Repository
    from fogspec.audit.review import Base, Whole, as_dict, removed, review
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.base.project_files import write_output
    from fogspec.compile.compiler import try_compile
    from fogspec.compile.inputs import Inputs
    from fogspec.spec.discover import check_specs
    from fogspec.spec.rules.policies import Policies

    repository = Repository()
    base = Base.of(repository, repository.base_of(range_))
    try:
        loaded, said = check_specs(specs)
    except InvalidInput:
        if not removed(repository, base.commit, ()):
            raise
        loaded, said = [], []  # the change removes the last of them
    rules, invalid = Policies(policies), [one for one in said if one.severity == "error"]
    inputs = Inputs.load([], catalog=catalog_path, audit=True, loaded=loaded)
    reviews = [review(status(one, try_compile(one)), base, rules) for one in inputs]
    # Which applications an invalid spec has is not known, so that none is said to be removed.
    gone = [] if invalid else removed(repository, base.commit, [one.name for one in reviews])
    whole = Whole(base.commit, reviews, gone, invalid)
    if output == "json":
        text = json_text(json.dumps(as_dict(whole), indent=2, ensure_ascii=False)) + "\n"
    else:
        text = markdown(whole, picture_base)
    if out is None:
        say_text(text, end="")
    else:
        write_output(out, text.encode())
    if wrong := [*invalid, *(found for one in reviews for found in one.broken)]:
        raise DiagnosticError(wrong)
    if exit_code and (stale := [one.name for one in reviews if not one.status.fresh]):
        raise OutOfDate(f"not fresh: {', '.join(stale)}", "fogspec status says why")
