"""Implement `fogspec check`: the gate in front of a merge."""

import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import is_verbose, note, say_json, say_text
from fogspec.base.errors import OutOfDate, UsageError
from fogspec.base.text import shell_command
from fogspec.cli.options import POLICIES, SPECS, WORKERS

if TYPE_CHECKING:
    from fogspec.base.diagnostics import Diagnostic
    from fogspec.language.loader import LoadedSpec
    from fogspec.review.gate import Verdicts
    from fogspec.review.git import Repository


@click.command()
@SPECS
@click.option(
    "--since",
    metavar="BASE",
    help="judge only applications that may be concerned by what changed since this commit, and files removed since",
)
@click.option(
    "--allow-policy-change",
    is_flag=True,
    help="with --since, accept that the change edits its policies, or where the live state is",
)
@click.option("--resolve-image", is_flag=True, help="accept an image that is not pinned, as apply --resolve-image does")
@click.option(
    "--statement", metavar="FILE", type=click.Path(path_type=str), help="compare with a statement of -o statement, too"
)
@WORKERS
@POLICIES
@click.option(
    "-o",
    "--output",
    type=click.Choice(["text", "json", "github", "statement"]),
    default="text",
    help="output format; github: with annotations, statement: in-toto, with the digests of all that is approved",
)
def command(
    specs: tuple[str, ...],
    since: str | None,
    allow_policy_change: bool,
    resolve_image: bool,
    statement: str | None,
    workers: int | None,
    policies: tuple[str, ...],
    output: str,
) -> None:
    """Check that apply would deploy exactly what is committed: one line per application.

    Each APP is a name or a spec, by default all in specs/. It passes if its spec is valid and meets the policies; if plan,
    results with their raw timings, models, menu and manifest follow from one another and from the lock; if images are pinned;
    if no manifest was removed, and no compiled file or deployment is left without its spec. With --since, the policies of BASE
    must be met, too. Nothing is written. With -v, the chain is shown from the spec to the manifest.

    Exit code 1 for an invalid spec, 3 for any other failure.
    """
    from fogspec.report.diagnostics import show_diagnostics
    from fogspec.review import gate
    from fogspec.review.diff import removed
    from fogspec.review.git import UNKNOWN_BASE, Rules, concerned

    repository, commit, is_known = _base(since)
    if commit is not None and not is_known:
        note(f"warning: {UNKNOWN_BASE.format(commit[:12])}")
    gone = [] if repository is None or commit is None else list(removed(repository, commit, ()))
    loaded, wrong = _specs(specs, gone)
    show_diagnostics(wrong, "github" if output == "github" else "text")
    names = {one.name for one in loaded}
    changed = None if since is None or repository is None or commit is None else repository.changed(commit)
    wanted = names if changed is None else concerned(loaded, map(os.path.realpath, changed))
    rules = Rules()
    if repository is not None and commit is not None and changed is not None:
        rules = Rules.of(repository, commit, _roots(loaded), changed)
    refused = () if allow_policy_change else rules.changed
    judged_by = gate.Gate(policies, rules, commit, resolve_image)
    verdicts = judged_by.judge([one for one in loaded if one.name in wanted], workers)
    invalid = sorted({one.span.path for one in wrong if one.severity == "error"})
    whole = not invalid and _are_all(specs, loaded)
    # What others may have added since is not gone.
    gone = gone if is_known else []
    others = _without_spec(loaded, gone, live=not any(map(_is_place, refused))) if whole else []
    found = gate.Verdicts(
        judged=verdicts, rules=refused, others=others, invalid=invalid, skipped=sorted(names - wanted), since=since
    )
    _show(found, output)
    _require(found, statement)
    if output == "statement":
        from fogspec.review.statement import text

        say_text(text(found.approved), end="")
    if found.approved:
        resolving = " --resolve-image" if resolve_image else ""
        note(f"apply{resolving} deploys what is {_deployed(repository, [one for one in loaded if one.name in wanted])}")


def _base(since: str | None) -> "tuple[Repository | None, str | None, bool]":
    """Return the repository, the commit to compare with, and whether it is known; None outside of one, or without a commit."""
    from fogspec.review.git import Repository

    try:
        repository = Repository()
    except UsageError:
        if since is not None:
            raise
        return None, None, True
    try:
        return repository, *repository.base_of(since or "HEAD")
    except UsageError:
        if since not in (None, "HEAD"):
            raise
        return repository, None, True  # there is no commit yet: all of it is new


def _deployed(repository: "Repository | None", judged: "Sequence[LoadedSpec]") -> str:
    """Return what apply deploys: what is committed, unless the next commit lacks compiled files, results or locks of these."""
    ours = [path for one in judged for path in (one.layout.compiled, one.layout.results, one.layout.lock)]
    try:
        found = [] if repository is None else repository.not_staged(filter(os.path.exists, ours))
    except UsageError:
        return "here"
    left = sorted(os.path.relpath(os.path.realpath(path)) for path in found if path.suffix != ".html")  # a report
    more = f" and {len(left) - 1} more" if len(left) > 1 else ""
    return f"here; not part of the commit yet: {left[0]}{more}" if left else "committed"


def _specs(specs: Sequence[str], gone: Sequence[str]) -> "tuple[list[LoadedSpec], list[Diagnostic]]":
    from fogspec.language.discover import NoSpecs, check_specs

    try:
        return check_specs(specs)
    except NoSpecs:
        if not gone:
            raise
        return [], []  # the change removes the last of them


def _roots(loaded: "Sequence[LoadedSpec]") -> list[Path]:
    return sorted({one.layout.root for one in loaded} or {Path()})


def _are_all(specs: Sequence[str], loaded: "Sequence[LoadedSpec]") -> bool:
    """Return whether these arguments lead to all specs of their projects: none, or folders that hold those of specs."""
    tops = (root / "specs" if (root / "specs").is_dir() else root for root in _roots(loaded))
    folders = [Path(one).resolve() for one in specs if os.path.isdir(one)]
    return not specs or (
        len(folders) == len(specs) and all(any(map(top.resolve().is_relative_to, folders)) for top in tops)
    )


def _is_place(rule: str) -> bool:
    from fogspec.base.layout import PROJECT

    return os.path.basename(rule) == PROJECT


def _without_spec(loaded: "Sequence[LoadedSpec]", gone: Collection[str], live: bool) -> list[str]:
    """Return files and deployments without a spec; tell what else may still run. Without `live`, no state is looked at."""
    from fogspec.deploy.housekeeping import without_application
    from fogspec.deploy.running import without_spec
    from fogspec.deploy.state import SystemWallClock
    from fogspec.deploy.stores import StoreUnavailable

    names, roots = {one.name for one in loaded}, _roots(loaded)
    others = [text for root in roots for text in without_application(root, [one.layout for one in loaded])]
    try:
        others += [text for root in roots if live for text in without_spec(root, names, SystemWallClock())]
    except StoreUnavailable as lost:
        note(f"what runs without a spec is not checked: {lost.message}")
    known = {text.partition(":")[0] for text in others} | names
    for name in (name for name in gone if name not in known):
        note(f"{name}: its spec and its manifest are gone; if it still runs: {shell_command('fogspec', 'down', name)}")
    return others


def _show(found: "Verdicts", output: str) -> None:
    """Print the verdicts; beside a statement on standard error."""
    from fogspec.review import gate

    if output == "json":
        say_json(gate.as_dict(found))
        return
    say_text(gate.as_text(found, is_verbose()), err=output == "statement")
    if output == "github":
        from fogspec.report.diagnostics import show_diagnostics

        show_diagnostics(list(gate.as_diagnostics(found)), output)


def _require(found: "Verdicts", statement: str | None) -> None:
    """End with 1 for an invalid spec. Raise OutOfDate for what is not as it should be, or not as a statement says."""
    if found.invalid:
        raise click.exceptions.Exit(1)
    if found.failed:
        files = any(text.partition(":")[0].startswith(("compiled", "results")) for text in found.others)
        remove = ["what has no spec is removed by: fogspec compile --prune"] if files else []
        raise OutOfDate(f"not what apply would deploy: {', '.join(found.failed[:9])}", *remove)
    if statement is not None:
        from fogspec.review.statement import differences

        if differing := differences(statement, found.approved):
            raise OutOfDate("not what was approved", *differing)
