"""Implement `fogspec status`: show fresh and stale stages with reasons, and the money spent."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.console import columns, is_verbose, note, say_json, say_text
from fogspec.base.errors import FogspecError, InvalidInput, Refused
from fogspec.base.text import paragraph, table
from fogspec.base.units import dollars
from fogspec.cli.next_steps import Words, after_status, next_command, next_lines, say_next
from fogspec.cli.options import OUTPUT, SPECS, WORKERS, raise_damaged, raise_together, show_read

if TYPE_CHECKING:
    from fogspec.base.diagnostics import Diagnostic
    from fogspec.base.layout import Layout
    from fogspec.deploy.health import HealthReport
    from fogspec.language.loader import LoadedSpec


@dataclass(frozen=True, slots=True)
class _Found:
    """The status of an application and of what runs of it, in lines and as data for JSON; passes between processes.

    `damaged` are errors of files that cannot be used, `refused` is why its live state cannot be. `known` is false if it is
    not known whether something runs. `following` are the words of the next command.
    """

    layout: "Layout"
    lines: Sequence[str]
    row: Sequence[str]
    following: Words | None
    data: dict[str, Any]
    damaged: "Sequence[Diagnostic]"
    refused: FogspecError | None
    live: "HealthReport | None"
    known: bool


@click.command()
@SPECS
@WORKERS
@OUTPUT
def command(specs: tuple[str, ...], workers: int | None, output: str) -> None:
    """Show the state of every stage, from spec to deployment; of several applications, a line each.

    Each APP is a name or a spec, by default all in specs/. Without APP, applications that run and have no spec are listed,
    too, also in a project without any spec. -v adds what commands did with its machines. Nothing is written.

    The deployed state has two words: sync (Synced, OutOfSync: is it what the manifest says) and health (Healthy, NotJudged,
    Drifted, Degraded, Progressing, Missing, Unknown: do its nodes answer, as fast as the model predicted; NotJudged: too few
    requests, or too different ones, to say).
    """
    from fogspec.deploy import health
    from fogspec.deploy.housekeeping import without_application
    from fogspec.deploy.running import layouts
    from fogspec.deploy.stores import StoreUnavailable
    from fogspec.language.discover import NoSpecs, check_specs
    from fogspec.review.shared_work import share

    nowhere: InvalidInput | None = None
    try:
        loaded, wrong = check_specs(specs)
    except NoSpecs as no:
        if specs:
            raise
        loaded, wrong = [], []
        nowhere = InvalidInput(f"{no.message}, and no machine in the live state", *no.hints)
    invalid = [one for one in wrong if one.severity == "error"]
    names = {one.name for one in loaded}
    strays, away = list["Layout"](), None
    roots = sorted({one.layout.root for one in loaded}) or [Path()]
    try:
        # With the first look, so that a store without contact is reported once, next to all that is known without it.
        listed = [one for root in roots for one in layouts(root) if one.name not in names]
        strays = [] if specs else listed
    except StoreUnavailable as lost:
        away = lost
    # What --verbose prints is said by this process.
    job = partial(_found, away is None)
    found = share(job, loaded, 1 if is_verbose() else workers) if loaded else []
    found += [one for layout in strays if (one := _without_spec(layout, None if invalid else False)) is not None]
    if not found:
        raise_damaged(invalid)
        raise_together([away, nowhere])
    if output == "json":
        deployments = (None if one.live is None else health.as_dict(one.live) for one in found)
        say_json([{**one.data, "deployment": live} for one, live in zip(found, deployments, strict=True)])
    elif not specs and len(found) > 1 and not is_verbose():
        rows = [["application", "state", "running", "spent"], *(one.row for one in found)]
        say_text("\n".join(table(rows, columns(), indent=0)))
        ending = [next_command(*one.following) for one in found if one.following and one.data["has_spec"] is False]
        say_next(f"{next_command('status', 'APP')} for the reasons and what comes next; -v for those of all", *ending)
    else:
        texts = [
            paragraph([*one.lines, *next_lines([None if one.following is None else next_command(*one.following)])])
            for one in found
        ]
        say_text("\n\n".join(texts))
    if not specs and not invalid:
        note(*(text for root in roots for text in without_application(root, [one.layout for one in loaded])))
    raise_damaged([*invalid, *(problem for one in found for problem in one.damaged)])
    raise_together([away, *(one.refused for one in found)])


def _found(with_live: bool, loaded: "Sequence[LoadedSpec]") -> list[_Found]:
    """Return the status of each application; what runs is not looked at if the store of its state is away."""
    from fogspec.backends.registry import deployment_backend
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.base.quantities import as_numbers
    from fogspec.check.audit import located, look
    from fogspec.compile.inputs import Inputs
    from fogspec.deploy import health
    from fogspec.deploy.state import DeploymentState, SystemWallClock
    from fogspec.review import status

    inputs = Inputs.load([], audit=True, each=True, recorded=True, loaded=loaded)
    show_read(inputs)
    found = []
    for one in inputs:
        own = look(one)
        live, unread, refused = None, tuple["Diagnostic", ...](), None
        try:
            if with_live:
                live = health.health_report(
                    one.application, one.layout, one.sent, own.fresh, SystemWallClock(), deployment_backend
                )
        except DiagnosticError as problems:
            unread = problems.diagnostics
        except Refused as no:
            refused = no
        known = with_live and not unread and refused is None
        history = DeploymentState.look(one.layout, SystemWallClock()).history if known else []
        running = health.as_text(live) if live else [f"  {'running':<9} unknown"] if not known else []
        state, spent = status.as_row(own)
        running += [f"  {'':<9} {text}" for text in (*map(located, unread), *([refused.message] if refused else []))]
        if is_verbose():
            running += [f"  {'history' if not n else '':<9} {act.text}" for n, act in enumerate(history)]
        found.append(
            _Found(
                layout=one.layout,
                lines=status.as_lines(own, running),
                row=(one.layout.name, state, _running(live, known), spent),
                # Where what runs is not known, to deploy may not be what comes next.
                following=after_status(own, live) if known or not own.fresh else None,
                data={**status.as_dict(own), "has_spec": True, "history": list(map(as_numbers, history))},
                damaged=(*own.damaged, *unread),
                refused=refused,
                live=live,
                known=known,
            )
        )
    return found


def _running(live: "HealthReport | None", known: bool) -> str:
    """Return what runs in a cell: its health, and whether it is what the manifest says."""
    if live is None:
        return "" if known else "unknown"
    return live.health if live.sync == "Synced" else f"{live.sync}, {live.health}"


def _without_spec(layout: "Layout", has_spec: bool | None) -> _Found | None:
    """Return what runs of an application that no valid spec has; None if nothing does.

    `has_spec` is None if it may have one, because not all specs can be read.
    """
    from fogspec.backends.registry import deployment_backend
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.deploy import health
    from fogspec.deploy.state import SystemWallClock

    live, damaged, refused = None, tuple["Diagnostic", ...](), None
    try:
        live = health.health_without_spec(layout, SystemWallClock(), deployment_backend)
        if live is None:
            return None
    except DiagnosticError as problems:
        damaged = problems.diagnostics
    except Refused as no:
        refused = no
    title = f"{layout.name} ({'no spec' if has_spec is False else 'not all specs can be read: fogspec validate'})"
    return _Found(
        layout=layout,
        lines=[title, *(health.as_text(live) if live else [f"  {'running':<9} unknown"])],
        row=(title, "", _running(live, live is not None), dollars(live.spent_usd) if live else "unknown"),
        following=("down", layout.name) if has_spec is False else None,
        data={"name": layout.name, "has_spec": has_spec, "stages": []},
        damaged=damaged,
        refused=refused,
        live=live,
        known=live is not None,
    )
