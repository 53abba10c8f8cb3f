"""Implement `fogspec status`: show fresh and stale stages with reasons, and the money spent."""

import click

from fogspec.base.console import note, say, say_json, say_text
from fogspec.base.errors import OutOfDate
from fogspec.base.text import line
from fogspec.cli.next_steps import after_status, next_lines
from fogspec.cli.options import CATALOG, SPECS, load_inputs


@click.command()
@SPECS
@CATALOG
@click.option(
    "-o",
    "--output",
    type=click.Choice(["text", "json", "openmetrics"]),
    default="text",
    help="output format; openmetrics: what runs, as metrics, also for node_exporter's textfile collector",
)
@click.option("--exit-code", is_flag=True, help="exit 3 when a stage is not fresh, or what runs is not well")
def command(specs: tuple[str, ...], catalog_path: str | None, output: str, exit_code: bool) -> None:
    """Say how things stand, from spec to what runs. SPECS are those in specs/; nothing is written.

    Without SPECS, applications that run and have no spec any more are listed, too.

    The deployed state has two words: sync (Synced, OutOfSync: is it what the manifest says) and health (Healthy, Drifted,
    Degraded, Progressing, Missing, Unknown: do its nodes answer, as fast as the model predicted).
    """
    from fogspec.audit import freshness, status
    from fogspec.backends.registry import deployment_backend
    from fogspec.base.git import tracked_note
    from fogspec.compile.compiler import try_compile
    from fogspec.deploy import health
    from fogspec.deploy.git_store import StoreUnavailable
    from fogspec.deploy.running import without_spec
    from fogspec.deploy.state import SystemWallClock

    inputs = load_inputs(specs, catalog_path, audit=True)
    names = {one.layout.name for one in inputs}
    others, away = list[str](), None
    try:
        # With the first look, so that a store without contact is said once, beside all that is known without it.
        roots = sorted({one.layout.root for one in inputs})
        listed = [text for root in roots for text in without_spec(root, names, SystemWallClock())]
        others = [] if specs else listed
    except StoreUnavailable as lost:
        away = lost
    found = [freshness.status(one, try_compile(one)) for one in inputs]
    note(*dict.fromkeys(said for one in inputs if (said := tracked_note(one.layout)) is not None))
    lives = [
        None
        if away is not None
        else health.health_report(
            one.inputs.application, one.layout, one.inputs.sent, one.fresh, SystemWallClock(), deployment_backend
        )
        for one in found
    ]
    if output == "json":
        data = [
            {**status.as_dict(one), "deployment": None if live is None else health.as_dict(live)}
            for one, live in zip(found, lives, strict=True)
        ]
        say_json(data)
        say(*others, err=True)
    elif output == "openmetrics":
        from fogspec.deploy.events import Events
        from fogspec.deploy.openmetrics import Metrics

        reports = {one.layout.name: live for one, live in zip(found, lives, strict=True)}
        restarts = {one.layout.name: Events(one.layout, SystemWallClock()).restarts() for one in found}
        say_text(Metrics(reports, restarts).text(), end="")
        say(*others, err=True)
    else:
        texts = [
            status.as_text(one, health.as_text(live) if live else (), next_lines([after_status(one, live)]))
            for one, live in zip(found, lives, strict=True)
        ]
        say_text("\n\n".join([*texts, *map(line, others)]))
    if away is not None:
        raise away
    unwell = [
        one.layout.name
        for one, live in zip(found, lives, strict=True)
        if not (one.fresh and (live is None or live.well))
    ]
    unwell += [text.partition(":")[0] for text in others]
    if exit_code and unwell:
        raise OutOfDate(f"not everything is fresh and as predicted: {', '.join(unwell)}")
