"""Implement `fogspec watch`: keep deployments serving."""

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.console import ask, say, say_json
from fogspec.base.errors import FogspecError, Interrupted, InvalidInput, Refused, UsageError
from fogspec.base.units import parse_duration_s
from fogspec.cli.options import OUTPUT, complete_application, quantity

if TYPE_CHECKING:
    from fogspec.base.layout import Layout
    from fogspec.deploy.watch import Watched, Watcher
    from fogspec.language.schema import Application

STEP_S = 0.2


@click.command()
@click.argument("apps", nargs=-1, metavar="[APP]...", shell_complete=complete_application)
@click.option("--once", is_flag=True, help="check once, restart what does not serve, and stop; for cron")
@click.option("--interval", default="30s", show_default=True, metavar="TIME", help="time between two checks")
@click.option(
    "--max-restarts",
    default=3,
    show_default=True,
    type=click.IntRange(0, 60),
    metavar="N",
    help="most machines started per hour for one application; 0 only reports",
)
@click.option(
    "--prices",
    metavar="FROM",
    help="price catalog of the price check, as compile --catalog  [default: that of the plan]",
)
@click.option("--yes", is_flag=True, help="skip the confirmation prompt")
@OUTPUT
def command(
    apps: tuple[str, ...],
    once: bool,
    interval: str,
    max_restarts: int,
    prices: str | None,
    yes: bool,
    output: str,
) -> None:
    """Check deployments at regular intervals, and replace a machine that does not serve.

    Each APP is a name or a spec, by default all in specs/ that run. A machine is started only where nodes have ended for
    good, or where the machine is gone: by the manifest that it ran, at the approved price at most, and before what is left
    of the old one ends. Where a machine cannot be reached, nothing is started. Drift and other manifests are reported.

    Events are kept in .fogspec/NAME/events.jsonl, metrics in .fogspec/metrics.prom. Ctrl-C ends the watch and leaves the
    deployments. With --once the exit code is 6 if something does not serve.
    """
    from functools import cache, partial

    from fogspec.backends.registry import deployment_backend
    from fogspec.base.signals import interruptible
    from fogspec.deploy.state import SystemWallClock
    from fogspec.deploy.watch import Watcher, check_serving

    every_s = quantity("--interval", interval, parse_duration_s)
    if every_s <= 0:
        raise UsageError(f"--interval {interval}: must be more than zero", "write --interval 30s")
    times = SystemWallClock()
    watcher = Watcher(
        times=times,
        backend_for=cache(deployment_backend),
        restarts_per_hour=max_restarts,
        tell=partial(_tell, output),
        prices=None if prices is None else partial(_prices, prices),
    )
    watcher.take(_applications(apps, {}))
    _confirm(watcher, yes or max_restarts == 0)
    with interruptible() as interrupt:
        while True:
            watcher.round(lambda: interrupt.asked)
            try:
                watcher.write_metrics()
            except InvalidInput as failed:
                say(f"warning: {failed.message}", err=True)  # the deployments matter more
            if once:
                check_serving([*watcher.watched.values()])
                return
            end_s = times.now_s() + every_s
            while times.now_s() < end_s and not interrupt.asked:
                times.sleep(min(STEP_S, max(0.0, end_s - times.now_s())))
            if interrupt.asked:
                raise Interrupted("the watch is over: what runs is left as it is")
            watcher.take(_applications(apps, watcher.watched))


def _applications(apps: Sequence[str], before: "Mapping[str, Watched]") -> "dict[str, tuple[Application, Layout]]":
    """Return the applications that are watched, by name.

    One whose spec is damaged or gone for now stays as it was. Raise DiagnosticError and NoSpecs for that at the start.
    """
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.deploy.shared_state import store_of
    from fogspec.language.discover import NoSpecs, check_specs, load_specs

    found = {name: (one.application, one.layout) for name, one in before.items()}
    try:
        loaded = load_specs(apps) if apps else check_specs()[0]
    except (DiagnosticError, UsageError, InvalidInput) as wrong:
        if not before and (apps or isinstance(wrong, NoSpecs)):
            raise
        loaded = []
    for one in loaded:
        layout = one.layout
        if apps or layout.files.is_file(layout.live) or store_of(layout) is not None:
            found[one.name] = one.application, layout
    return found


def _confirm(watcher: "Watcher", sure: bool) -> None:
    """Show what each restart may cost, and ask."""
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.deploy.state import DeploymentState

    times = watcher.restarts_per_hour
    for name, one in watcher.watched.items():
        try:
            machines = DeploymentState.look(one.layout, watcher.times).machines
            unknown = "nothing runs"
        except (DiagnosticError, FogspecError):
            machines, unknown = [], "what runs is not known"
        what = [f"{m.machine.instance} in {m.machine.infra}, {m.machine.price_words}" for m in machines[-1:]]
        said = f"; restarted at most {times} times per hour, at the approved price" if times else "; reported only"
        say(f"{name}: {what[0] if what else unknown}{said}", err=True)
    if not watcher.watched:
        say("nothing runs", err=True)
    if sure or not watcher.watched:
        return
    if not sys.stdin.isatty():
        raise Refused(
            "confirmation required, and no terminal is attached",
            "pass --yes to approve restarts at these prices, or --max-restarts 0 to report only",
        )
    if not ask("restart them when they do not serve?"):
        raise Refused("nothing is watched")


def _prices(origin: str, opened: Any) -> Any:
    from fogspec.catalog.sources import load_catalog
    from fogspec.compile.inputs import clouds_of

    return load_catalog(origin, clouds_of(opened.loaded))


def _tell(output: str, event: Mapping[str, Any]) -> None:
    if output == "json":
        say_json(event, indent=None)
        return
    date = f"{event['date']}  " if "date" in event else ""
    machine = f" ({event['machine']})" if event.get("machine") else ""
    say(f"{date}{event['application']}: {event['event']}: {event['text']}{machine}")
