"""`fogspec review`: what a change deploys, for whoever reviews it."""

from pathlib import Path

import click

from fogspec.base.errors import InvalidInput, OutOfDate
from fogspec.cli.options import CATALOG, POLICIES, catalogs_for


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
    range_: str, specs: tuple[str, ...], catalog_path: str | None, policies: tuple[str, ...], out: Path | None,
    picture_base: str | None, exit_code: bool,
) -> None:  # fmt: skip
    """Write Markdown about every manifest that differs between BASE and what is checked out. SPECS are those in specs/.

    The choice, what it costs before and after, which inputs changed, provenance, and whether everything is fresh.
    """
    from fogspec.audit.git import Repository
    from fogspec.audit.review import markdown, removed, review
    from fogspec.base.files import write_bytes
    from fogspec.compile.manifest import Manifest
    from fogspec.spec.discover import find_specs
    from fogspec.spec.loader import load
    from fogspec.spec.rules.policies import Policies

    repository = Repository()
    commit = repository.base_of(range_)
    try:
        loaded = load(find_specs(specs))
    except InvalidInput:
        if not removed(repository, commit, ()):
            raise
        loaded = []  # the change removes the last of them
    reviews = [
        review(one, catalog, repository, commit)
        for one, catalog in zip(loaded, catalogs_for(loaded, catalog_path), strict=True)
    ]
    gone = removed(repository, commit, [one.application.metadata.name for one in loaded])
    text = markdown(reviews, gone, picture_base)
    if out is None:
        click.echo(text, nl=False)
    else:
        write_bytes(out, text.encode())
    rules = Policies(policies)
    rules.require_specs(loaded)
    rules.require_manifests(loaded, Manifest)
    if exit_code and (stale := [one.difference.layout.name for one in reviews if not one.fresh]):
        raise OutOfDate(f"not fresh: {', '.join(stale)}", "fogspec status says why")
