"""Implement `fogspec status`: show fresh and stale stages with reasons, and the money spent."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.console import is_verbose, note, say, say_json, say_text
from fogspec.base.errors import FogspecError, OutOfDate, Refused
from fogspec.base.text import line, paragraph
from fogspec.cli.next_steps import Words, after_status, next_command, next_lines
from fogspec.cli.options import CATALOG, SPECS, WORKERS, raise_damaged, raise_together, show_read

if TYPE_CHECKING:
    from fogspec.base.diagnostics import Diagnostic
    from fogspec.base.layout import Layout
    from fogspec.deploy.health import HealthReport
    from fogspec.spec.loader import LoadedSpec


@dataclass(frozen=True, slots=True)
class _Found:
    """The status of an application and of what runs of it, in lines and as data for JSON; passes between processes.

    `damaged` are errors of files that cannot be used, `refused` is why its live state cannot be. `known` is false if it is
    not known whether something runs. `following` are the words of the next command, `tracked` is what to note of live state
    that git tracks.
    """

    layout: "Layout"
    lines: Sequence[str]
    following: Words | None
    data: dict[str, Any]
    fresh: bool
    damaged: "Sequence[Diagnostic]"
    refused: FogspecError | None
    live: "HealthReport | None"
    known: bool
    tracked: str | None


@click.command()
@SPECS
@WORKERS
@CATALOG
@click.option(
    "-o",
    "--output",
    type=click.Choice(["text", "json", "openmetrics"]),
    default="text",
    help="output format; openmetrics: the deployments as metrics, also for node_exporter's textfile collector",
)
@click.option("--exit-code", is_flag=True, help="exit 3 if a stage is not fresh, or a deployment is not healthy")
def command(
    specs: tuple[str, ...], workers: int | None, catalog_path: str | None, output: str, exit_code: bool
) -> None:
    """Show the state of every stage, from spec to deployment.

    Each APP is a name or a spec, by default all in specs/. Without APP, applications that run and have no spec any more are
    listed, too. Nothing is written.

    The deployed state has two words: sync (Synced, OutOfSync: is it what the manifest says) and health (Healthy, Drifted,
    Degraded, Progressing, Missing, Unknown: do its nodes answer, as fast as the model predicted).
    """
    from fogspec.audit.shared_work import share
    from fogspec.deploy import health
    from fogspec.deploy.running import without_spec
    from fogspec.deploy.state import SystemWallClock
    from fogspec.deploy.stores import StoreUnavailable
    from fogspec.spec.discover import check_specs

    loaded, wrong = check_specs(specs)
    invalid = [one for one in wrong if one.severity == "error"]
    if not loaded:
        raise_damaged(invalid)
    names = {one.name for one in loaded}
    others, away = list[str](), None
    try:
        # With the first look, so that a store without contact is said once, beside all that is known without it.
        roots = sorted({one.layout.root for one in loaded})
        listed = [text for root in roots for text in without_spec(root, names, SystemWallClock())]
        others = [] if specs or invalid else listed
    except StoreUnavailable as lost:
        away = lost
    # What --verbose prints is said by this process.
    found = share(partial(_found, catalog_path, away is None), loaded, 1 if is_verbose() else workers)
    note(*dict.fromkeys(one.tracked for one in found if one.tracked is not None))
    if output == "json":
        deployments = (None if one.live is None else health.as_dict(one.live) for one in found)
        say_json([{**one.data, "deployment": live} for one, live in zip(found, deployments, strict=True)])
        say(*others, err=True)
    elif output == "openmetrics":
        from fogspec.deploy.events import Events
        from fogspec.deploy.openmetrics import Metrics

        reports = {one.layout.name: one.live for one in found if one.known}
        restarts = {one.layout.name: Events(one.layout, SystemWallClock()).restarts() for one in found}
        say_text(Metrics(reports, restarts).text(), end="")
        say(*others, err=True)
    else:
        texts = [
            paragraph([*one.lines, *next_lines([None if one.following is None else next_command(*one.following)])])
            for one in found
        ]
        say_text("\n\n".join([*texts, *map(line, others)]))
    raise_damaged([*invalid, *(problem for one in found for problem in one.damaged)])
    raise_together([away, *(one.refused for one in found)])
    unwell = [one.layout.name for one in found if not (one.fresh and (one.live is None or one.live.well))]
    unwell += [text.partition(":")[0] for text in others]
    if exit_code and unwell:
        raise OutOfDate(f"not everything is fresh and as predicted: {', '.join(unwell)}")


def _found(catalog: str | None, with_live: bool, loaded: "Sequence[LoadedSpec]") -> list[_Found]:
    """Return the status of each application; what runs is not looked at if the store of its state is away."""
    from fogspec.audit import freshness, status
    from fogspec.backends.registry import deployment_backend
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.base.git import tracked_note
    from fogspec.compile.inputs import Inputs
    from fogspec.deploy import health
    from fogspec.deploy.state import SystemWallClock

    inputs = Inputs.load([], catalog=catalog, audit=True, each=True, loaded=loaded)
    show_read(inputs)
    found = []
    for one in inputs:
        own = freshness.look(one)
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
        running = health.as_text(live) if live else [f"  {'running':<9} unknown"] if not known else []
        running += [
            f"  {'':<9} {text}" for text in (*map(freshness.located, unread), *([refused.message] if refused else []))
        ]
        found.append(
            _Found(
                layout=one.layout,
                lines=status.as_lines(own, running),
                # Where what runs is not known, to deploy may not be what comes next.
                following=after_status(own, live) if known or not own.fresh else None,
                data=status.as_dict(own),
                fresh=own.fresh,
                damaged=(*own.damaged, *unread),
                refused=refused,
                live=live,
                known=known,
                tracked=tracked_note(one.layout),
            )
        )
    return found
