"""`fogspec bench`: measure the plan's samples."""

import json
import sys
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.outcomes import Refused, WrongCommand, WrongFile
from fogspec.cli.options import SPEC

if TYPE_CHECKING:
    from fogspec.effects.preparing import Prepared
    from fogspec.effects.sampling import Campaign
    from fogspec.effects.watching import Watcher
    from fogspec.seams import Runner


@click.command()
@SPEC
@click.option("--runner", "runner_name", type=click.Choice(["local", "replay"]), required=True, help="where to measure")
@click.option("--from", "recorded", type=click.Path(path_type=str), metavar="RESULTS.yaml", help="what to replay")
@click.option("--only", metavar="ID,…", default="", help="measure these samples, again if need be")
@click.option("--dry-run", is_flag=True, help="say what would be measured and what it costs, and stop")
@click.option("-o", "--output", type=click.Choice(["text", "json"]), default="text", help="form of progress and answer")
def command(spec: str, runner_name: str, recorded: str | None, only: str, dry_run: bool, output: str) -> None:
    """Measure what is not measured yet.

    Goes on where an earlier bench stopped: finished samples are not measured again, machines that were left running
    are taken down. Results are written after every sample. The first Ctrl-C stops cleanly, the second at once.
    """
    from fogspec.effects.benching import bench
    from fogspec.effects.preparing import prepare
    from fogspec.effects.specfiles import load

    runner = _runner(runner_name, recorded)
    names = [name.strip() for name in only.split(",") if name.strip()]
    unusable = []
    for one in load([spec]):
        prepared = prepare(one.application, one.path, names)
        _check_place(prepared, runner)
        click.echo(_price(prepared, runner), err=True)
        if prepared.outdated:
            kept = f"it is kept in a folder {prepared.layout.name}.old-… beside it"
            click.echo(f"{prepared.layout.results} measured something else than the spec says now: {kept}", err=True)
        if dry_run:
            continue
        results = bench(prepared, runner, lambda campaign, p=prepared: _watcher(campaign, p, output))  # type: ignore[misc]
        _report(prepared, results, output)
        if not any(record.state == "ok" for record in results.spec.samples):
            unusable.append(prepared.layout.name)
    if unusable:
        raise WrongFile(f"{', '.join(unusable)}: no sample could be measured", "the records above say why")


def _runner(name: str, recorded: str | None) -> "Runner":
    from fogspec import wiring

    if (name == "replay") != (recorded is not None):
        raise WrongCommand("--runner replay and --from RESULTS.yaml go together")
    if recorded is None:
        runner: Runner = wiring.runner(name)()
        return runner
    from fogspec.effects.clock import SystemClock
    from fogspec.effects.measured import recordings

    recordings_, source = recordings(recorded)
    replay: Runner = wiring.runner(name)(recordings_, source, SystemClock().now_s)
    return replay


def _check_place(prepared: "Prepared", runner: "Runner") -> None:
    """A local runner cannot stand in for a cloud's machines: its figures would carry their names and prices."""
    elsewhere = [s.machine for s in prepared.todo if s.machine.infra != "local"]
    if runner.name == "local" and elsewhere:
        raise Refused(
            f"{prepared.layout.name}: {elsewhere[0].infra} {elsewhere[0].instance} cannot be measured on this machine",
            "to measure here, list shapes such as local/2cpu-4gib under spec.benchmark.machines and compile again",
        )


def _price(prepared: "Prepared", runner: "Runner") -> str:
    from fogspec.effects.compiling import money
    from fogspec.plan import lifetime_s

    body = prepared.plan.spec
    count = f"{prepared.layout.name}: {len(prepared.todo)} of {len(body.samples)} samples to measure"
    if runner.costs != "real":
        return f"{count} with the {runner.name} runner: costs nothing"
    worst = sum(sample.machine.price for sample in prepared.todo) * lifetime_s(body.after, body.setup) / 3600
    return f"{count}: at most {money(worst)}"


def _watcher(campaign: "Campaign", prepared: "Prepared", output: str) -> "Watcher":
    from fogspec.effects import watching

    if output == "json":
        return watching.Events(click.echo)
    if sys.stderr.isatty():
        body = prepared.plan.spec
        return watching.LiveTable(prepared.todo, body.steps, body.budget, campaign.clock.now_s)
    return watching.Lines(lambda text: click.echo(text, err=True))


def _report(prepared: "Prepared", results: Any, output: str) -> None:
    from fogspec.effects import watching

    layout = prepared.layout
    if output == "json":
        click.echo(json.dumps(results.model_dump(mode="json", exclude_none=True)))
        return
    for record in results.spec.samples:
        click.echo(f"  {record.id}: {watching.outcome(record)}")
    click.echo(f"results   {layout.results}")
    click.echo(f"next: fogspec compile {layout.spec}")
