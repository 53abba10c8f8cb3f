"""Implement `fogspec diff`: show what compile would change, or with --since what a change deploys."""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import click

from fogspec.base.console import is_verbose, say_json, say_text
from fogspec.base.errors import Refused
from fogspec.cli.next_steps import after_diff, say_next
from fogspec.cli.options import OUTPUT, POLICIES, SPECS, raise_damaged, show_read

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fogspec.language.loader import LoadedSpec
    from fogspec.review.diff import Difference
    from fogspec.review.git import Base


@click.command()
@SPECS
@click.option("--since", metavar="BASE", help="compare what is checked out with this commit, as a pull request does")
@click.option("--markdown", "as_markdown", is_flag=True, help="write the comment of a pull request")
@click.option(
    "--picture-base", metavar="URL", help="URL below which the files of this commit are published, for links to charts"
)
@POLICIES
@OUTPUT
def command(
    specs: tuple[str, ...],
    since: str | None,
    as_markdown: bool,
    picture_base: str | None,
    policies: tuple[str, ...],
    output: str,
) -> None:
    """Compare each manifest with the one that compile would write and with the deployment, or with that of a commit.

    Each APP is a name or a spec, by default all in specs/. Shown are machine, costs and fields; which inputs and samples
    changed; what apply does with the machine; what must be measured first; and policies. BASE is a commit, or BASE..HEAD. The
    comment has at most 65,536 characters, GitHub's limit. Values of secrets are not shown. Nothing is written.

    Exit code 1 for an invalid spec, damaged results or a policy violation, after everything is printed.
    """
    from fogspec.language.discover import NoSpecs, check_specs
    from fogspec.review.comment import markdown
    from fogspec.review.deployed import Deployed
    from fogspec.review.diff import Whole, removed
    from fogspec.review.diff_text import as_dict, as_text
    from fogspec.review.git import Base, concerned
    from fogspec.review.shared_work import share

    base = None if since is None else Base.of(since)
    try:
        loaded, said = check_specs(specs)
    except NoSpecs:
        if base is None or not removed(base.repository, base.commit, (), whole=not specs):
            raise
        loaded, said = [], []  # the change removes the last of them
    invalid = [one for one in said if one.severity == "error"]
    wanted = {one.name for one in loaded} if base is None else concerned(loaded, base.paths)
    job = partial(differences, base, policies)
    # What --verbose prints is said by this process.
    found = share(job, [one for one in loaded if one.name in wanted], 1 if is_verbose() else None)
    others = {one.name: Deployed.at(one.layout) for one in loaded if one.name not in wanted}
    gone = {}
    if base is not None and not invalid:  # which applications an invalid spec has is not known
        gone = removed(base.repository, base.commit, [one.name for one in loaded], whole=not specs)
    whole = Whole(
        None if base is None else base.commit, found, others, gone, invalid, None if base is None else base.warning
    )
    if output == "json":
        say_json(as_dict(whole))
    elif as_markdown:
        say_text(markdown(whole, picture_base), end="")
    else:
        say_text(as_text(whole))
        say_next(*(after_diff(one) for one in found if base is None))
    raise_damaged(whole.problems)
    if lost := next((one.unknown for one in found if one.unknown is not None), None):
        raise lost


def differences(base: "Base | None", policies: tuple[str, ...], loaded: "Sequence[LoadedSpec]") -> "list[Difference]":
    """Return the difference of each application; without a base with what runs, unless the store of that is away."""
    from fogspec.compile.inputs import Inputs, policies_read
    from fogspec.deploy.health import running_changes
    from fogspec.deploy.state import SystemWallClock
    from fogspec.deploy.stores import StoreUnavailable
    from fogspec.language.rules.policies import Policies
    from fogspec.review.diff import difference

    inputs = Inputs.load([], audit=True, each=True, recorded=True, loaded=loaded)
    show_read(inputs)
    found, rules, away = list["Difference"](), Policies(policies, read=policies_read(inputs)), False
    for one in inputs:
        own = difference(one, base, rules)
        try:
            live = None if base or away else running_changes(one.layout, SystemWallClock(), one.sent)
            own = replace(own, running=None if live is None else tuple(live))
        except (Refused, StoreUnavailable) as lost:
            own, away = replace(own, unknown=lost), True
        found.append(own)
    return found
