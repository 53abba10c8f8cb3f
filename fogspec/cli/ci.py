"""Implement `fogspec ci`: the gate in front of a merge."""

import os
from pathlib import Path

import click

from fogspec.base.console import note, say_json, say_text
from fogspec.base.errors import OutOfDate, UsageError
from fogspec.base.text import shell_command
from fogspec.cli.options import CATALOG, OUTPUT, POLICIES, SPECS, WORKERS


@click.command()
@SPECS
@click.option(
    "--since", metavar="BASE", help="check only applications that changed since this commit, and files removed since"
)
@click.option("--resolve-image", is_flag=True, help="accept an image that is not pinned, as apply --resolve-image does")
@WORKERS
@CATALOG
@POLICIES
@OUTPUT
def command(
    specs: tuple[str, ...],
    since: str | None,
    resolve_image: bool,
    workers: int | None,
    catalog_path: str | None,
    policies: tuple[str, ...],
    output: str,
) -> None:
    """Check that apply would deploy exactly what is committed: one line per application.

    Each APP is a name or a spec, by default all in specs/. Every spec is valid and meets the policies; plan, results,
    models, menu and manifest follow from one another and from the lock; images are pinned; no manifest was removed, and no
    compiled file and no deployment is left without its spec. Nothing is written.

    Exit code 1 for an invalid spec, 3 for any other failure.
    """
    from fogspec.audit import gate
    from fogspec.audit.git import Repository
    from fogspec.audit.review import removed
    from fogspec.deploy.running import without_spec
    from fogspec.deploy.state import SystemWallClock
    from fogspec.deploy.stores import StoreUnavailable
    from fogspec.report.diagnostics import show_diagnostics
    from fogspec.spec.discover import NoSpecs, check_specs

    repository, commit = None, None
    try:
        repository = Repository()
        commit = repository.base_of(since or "HEAD")
    except UsageError:
        if since not in (None, "HEAD") or (since == "HEAD" and repository is None):
            raise
        since = None  # there is no commit yet: all of it is new
    gone = [] if repository is None or commit is None else [one.name for one in removed(repository, commit, ())]
    try:
        loaded, wrong = check_specs(specs)
    except NoSpecs:
        if not gone:
            raise
        loaded, wrong = [], []  # the change removes the last of them
    show_diagnostics(wrong)
    invalid = sorted({one.span.path for one in wrong if one.severity == "error"})
    names = {one.name for one in loaded}
    wanted = names
    if since is not None and repository is not None and commit is not None:
        wanted = gate.changed(loaded, repository.changed(commit))
    chosen = [one for one in loaded if one.name in wanted]
    judged_by = gate.Gate(catalog_path, policies, commit, resolve_image)
    verdicts = judged_by.judge(chosen, workers)
    whole = not invalid and all(map(os.path.isdir, specs))
    roots = {one.layout.root for one in loaded} or {Path()}
    others = [text for root in sorted(roots) for text in gate.leftovers(root, names)] if whole else []
    files = len(others)
    if whole:
        try:
            others += [text for root in sorted(roots) for text in without_spec(root, names, SystemWallClock())]
        except StoreUnavailable as lost:
            note(f"what runs without a spec is not checked: {lost.message}")
    known = {text.partition(":")[0] for text in others}
    for name in (name for name in gone if whole and name not in names and name not in known):
        note(f"{name}: its spec and its manifest are gone; if it still runs: {shell_command('fogspec', 'down', name)}")
    skipped = sorted(names - wanted)
    if output == "json":
        say_json(gate.as_dict(verdicts, others, invalid, skipped))
    else:
        say_text(gate.as_text(verdicts, others, invalid, len(skipped), since))
    if invalid:
        raise click.exceptions.Exit(1)
    if failed := [one.name for one in verdicts if one.problems] or others:
        raise OutOfDate(
            f"not what apply would deploy: {', '.join(failed[:9])}",
            "fogspec status and fogspec verify say more",
            *(["what has no spec is removed by: fogspec compile --prune"] if files else []),
        )
    note(f"apply{' --resolve-image' if resolve_image else ''} deploys what is committed")
