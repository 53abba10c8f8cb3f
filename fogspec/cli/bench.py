"""Implement `fogspec bench`: measure the samples of the plan."""

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import ask, is_quiet, note, say, say_json
from fogspec.base.errors import FogspecError, InvalidInput, OutOfDate, Refused, UsageError
from fogspec.base.text import shell_command
from fogspec.cli.next_steps import next_command, same_command, say_next
from fogspec.cli.options import (
    CATALOG,
    PRIORS,
    SPEC,
    Dollars,
    applications_of,
    check_image,
    library_from,
    load_named,
    require_ready,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fogspec.backends.protocol import SampleBackend
    from fogspec.bench.campaign import Campaign
    from fogspec.bench.confirm import Expected
    from fogspec.bench.prepare import Prepared
    from fogspec.bench.progress import ProgressReporter
    from fogspec.bench.quote import Quote
    from fogspec.bench.run import BenchResult
    from fogspec.catalog.table import Catalog
    from fogspec.numerics.priors import PriorData
    from fogspec.spec.loader import LoadedSpec, SourceFile

RUNNERS = ["local", "replay", "skypilot"]


@click.command()
@SPEC
@click.option(
    "--runner",
    "runner_name",
    type=click.Choice(RUNNERS),
    help="where to measure; local: shapes of this host  [default: by the machines of the plan]",
)
@click.option(
    "--from",
    "recorded",
    type=click.Path(path_type=str),
    metavar="FILE",
    help="recording to replay: results (YAML) or a sweep (CSV with instance_type, latency_s)",
)
@click.option(
    "--pace",
    type=click.FloatRange(0),
    default=0.0,
    metavar="SECONDS",
    help="replay: wait for each recorded second",
)
@click.option("--only", metavar="ID,…", default="", help="measure only these samples, again if they have a result")
@click.option(
    "--confirm",
    is_flag=True,
    help="measure the chosen machine again; if it agrees, stale results stay valid",
)
@click.option(
    "--at-once",
    type=click.IntRange(1, 64),
    metavar="N",
    help="most machines at the same time  [default: 8 with SkyPilot, 1 on this computer]",
)
@click.option("--resume", is_flag=True, help="tear down machines that another bench of this application left running")
@click.option(
    "--max", "max_usd", type=Dollars(), help="most money that this run may spend  [default: the rest of the budget]"
)
@click.option("--yes", is_flag=True, help="skip the confirmation prompt")
@click.option("--dry-run", is_flag=True, help="show what would be measured and what it costs, and stop")
@CATALOG
@PRIORS
@click.option("-o", "--output", type=click.Choice(["text", "json"]), default="text", help="output format")
def command(
    spec: str,
    runner_name: str | None,
    recorded: str | None,
    pace: float,
    only: str,
    confirm: bool,
    at_once: int | None,
    resume: bool,
    max_usd: float | None,
    yes: bool,
    dry_run: bool,
    catalog_path: str | None,
    priors: Path | None,
    output: str,
) -> None:
    """Measure the samples of APP that have no result yet.

    APP is a name or a spec. Resumes where an earlier bench stopped: finished samples are not measured again, machines that
    were left running are torn down. Results are written after every sample. The first Ctrl-C stops cleanly, the second at
    once.
    """
    from fogspec.backends.protocol import Costs
    from fogspec.bench.confirm import confirming
    from fogspec.bench.prepare import prepare
    from fogspec.bench.quote import Quote, check_prices
    from fogspec.bench.run import BenchOptions, bench

    names = [name.strip() for name in only.split(",") if name.strip()]
    if confirm and names:
        raise UsageError("--confirm and --only exclude each other", "--confirm measures the chosen machine")
    unusable, refuted, measures = [], [], False
    known: dict[Path, SourceFile] = {}
    applications = applications_of(spec)
    _check_measured(applications)
    require_ready(applications, started=True, files=recorded is None)
    for one in applications:
        prepared = prepare(one.application, one.path, names, known)
        expected = None
        if confirm:
            prepared, expected = confirming(prepared, load_named(one.path, one.name, catalog_path, priors)[0])
        backend = _backend(prepared, runner_name, recorded, pace)
        # Machines of a cloud do not slow one another down; jobs on this computer do.
        raised = backend.costs is Costs.REAL
        backend.at_once = min(at_once or backend.at_once, 64 if raised else backend.at_once)
        _check_place(prepared, backend)
        offering = Quote.of(prepared, backend, max_usd, once_more=confirm)
        _offer(prepared, backend, offering, expected)
        catalog, prices = _catalogs(one, catalog_path, prepared, backend)
        if prices is not None:
            check_prices(prepared.todo, prices, shell_command("fogspec", "compile", prepared.layout.spec))
        if dry_run:
            measures |= bool(offering.todo) or offering.adaptive
            say(*offering.lines(), *_payoff(prepared, catalog, priors))
            continue
        _check_needed(prepared, backend)
        if places := {sample.machine.infra for sample in prepared.todo}:
            backend.check_access(places)
        _confirm(offering, yes)
        library = _library(prepared, priors) if catalog is not None else None
        terms = BenchOptions(max_usd, resume, catalog, prices, library, expected)
        watcher = partial(_watcher, prepared=prepared, output=output, more=offering.adaptive)
        benched = bench(prepared, backend, watcher, terms)
        _report(prepared, benched, output)
        if not any(record.state == "ok" for record in benched.results.spec.samples):
            unusable.append(prepared.layout.name)
        if expected is not None and benched.confirmed is None:
            refuted.append(prepared.layout.name if benched.compared else f"{prepared.layout.name} (not measured)")
    if dry_run and output == "text":
        say_next(same_command(without="dry_run") if measures else next_command("compile", applications[0].path))
    if unusable:
        raise InvalidInput(
            f"{', '.join(unusable)}: no sample could be measured", "the lines above say why, and where the logs are"
        )
    _require_confirmed(refuted)


def _require_confirmed(refuted: "Sequence[str]") -> None:
    """Raise OutOfDate for applications whose older results were not confirmed."""
    if refuted:
        raise OutOfDate(
            f"not confirmed: {', '.join(refuted)}: the older results stay stale", "measure the plan: fogspec bench"
        )


def _offer(prepared: "Prepared", backend: "SampleBackend", offering: "Quote", expected: "Expected | None") -> None:
    """Say what would be measured, what it costs, and what becomes of the results on disk."""
    from fogspec.bench.run import without_image

    tell = partial(say, err=True) if offering.needs_consent else note  # what money is asked for is always said
    lines = [
        *([] if expected is None else [expected.line]),
        *offering.together(backend.at_once),
        *offering.unattended(),
    ]
    tell(offering.line(), *(f"  {text}" for text in lines))
    if (spent := offering.spent_line(prepared)) is not None:
        tell(spent)
    note(
        *backend.notes,
        *without_image(prepared.application, backend),
        *(f"  {text}" for text in prepared.not_admitted),
    )
    if prepared.outdated:
        kept = f"it is kept in a folder {prepared.layout.name}.old-… beside it"
        note(f"{prepared.layout.results} measured something else than the spec says now: {kept}")


def _check_measured(applications: "list[LoadedSpec]") -> None:
    """Raise UsageError for an application in an environment: the default one is measured for all."""
    for one in applications:
        if one.base is not None:
            name = one.layout.application
            raise UsageError(
                f"{one.name}: what is measured of {name} serves all of its environments",
                shell_command("fogspec", "bench", name),
            )


def _backend(prepared: "Prepared", name: str | None, recorded: str | None, pace: float) -> "SampleBackend":
    from fogspec.backends.registry import sample_backend

    local = all(sample.machine.is_local for sample in prepared.plan.spec.samples)
    name = name or ("replay" if recorded is not None else "local" if local else "skypilot")
    if (name == "replay") != (recorded is not None):
        raise UsageError("--runner replay and --from FILE go together")
    if name not in RUNNERS:
        raise UsageError(f"--runner: say where to measure: {', '.join(RUNNERS)}")
    if recorded is None:
        backend: SampleBackend = sample_backend(name)()
        return backend
    from fogspec.base.clock import SystemClock
    from fogspec.bench.replay import replayable

    found, source = replayable(recorded, prepared.plan.spec.duration)
    replay: SampleBackend = sample_backend(name)(found, source, SystemClock().now_s, pace)
    return replay


def _check_place(prepared: "Prepared", backend: "SampleBackend") -> None:
    """Raise Refused if a local runner would measure cloud machines, whose names and prices its results would carry."""
    elsewhere = [s.machine for s in prepared.todo if not s.machine.is_local]
    if backend.name == "local" and elsewhere:
        raise Refused(
            f"{prepared.layout.name}: {elsewhere[0].infra} {elsewhere[0].instance} cannot be measured on this machine",
            "to measure here, list shapes such as local/2cpu-4gib under spec.benchmark.machines and compile again",
        )


def _check_needed(prepared: "Prepared", backend: "SampleBackend") -> None:
    """Raise FogspecError for files that are not sent, missing secrets and a missing image, before a machine is paid for."""
    from fogspec.base.redaction import check_set
    from fogspec.spec.lock_io import check_sent, read_pins
    from fogspec.spec.lockfile import image_named, pinned

    if backend.costs != "recorded":
        check_sent(prepared.application, prepared.layout, measured=True)
        check_set(prepared.application.spec.secrets if prepared.todo else ())
    if backend.costs == "real" and prepared.todo:
        exact = pinned(prepared.application, read_pins(prepared.layout))
        check_image(image_named(exact), prepared.application.spec)


def _catalogs(
    one: "LoadedSpec", path: str | None, prepared: "Prepared", backend: "SampleBackend"
) -> "tuple[Catalog | None, Catalog | None]":
    """Return the catalog for an adaptive campaign and the catalog of current prices; None if it is not needed.

    Raise OutOfDate if the plan was compiled from another catalog.
    """
    from fogspec.catalog.sources import load_catalog
    from fogspec.compile.inputs import catalogs_for, clouds_of

    real, adaptive = backend.costs == "real", prepared.plan.spec.sampler == "adaptive"
    if not real and not adaptive:
        return None, None
    catalog = catalogs_for([one], path)[0]
    if adaptive and catalog.about.digest != prepared.plan.spec.catalog.digest:
        compiling = shell_command("fogspec", "compile", prepared.layout.spec, *(["--catalog", path] if path else []))
        raise OutOfDate(
            f"{prepared.layout.plan} was compiled from another catalog: {prepared.plan.spec.catalog.source}", compiling
        )
    if not real:
        return catalog, None
    try:
        prices = load_catalog("skypilot", clouds_of(one))
    except FogspecError as unavailable:
        note(f"prices are compared with {catalog.about.source}, not with SkyPilot's own: {unavailable.message}")
        prices = catalog
    return catalog if adaptive else None, prices


def _library(prepared: "Prepared", path: Path | None) -> "PriorData | None":
    """Return the machine library of an adaptive campaign, from the command line or else from the lock."""
    from fogspec.model.priors import locked_priors
    from fogspec.spec.lock_io import read_pins

    return library_from(path) or locked_priors(prepared.layout, read_pins(prepared.layout))


def _payoff(prepared: "Prepared", catalog: "Catalog | None", priors: Path | None) -> list[str]:
    """Return what the benchmark is expected to spend and save, before anything was measured."""
    application = prepared.application
    if application.spec.benchmark.volume is None or catalog is None or prepared.results is not None:
        return []
    from fogspec.catalog.filters import filter_offers
    from fogspec.choice.payoff import expected_payoff
    from fogspec.plan.design import max_cost_usd

    offers = filter_offers(catalog, application.spec.hardware, application.spec.infra).offers
    usd = max_cost_usd(application.spec, offers.price_usd_per_hour)
    found = expected_payoff(application, offers, usd, _library(prepared, priors))
    return [] if found is None else [f"  {found.line()}"]


def _confirm(offering: "Quote", yes: bool) -> None:
    """Raise Refused unless the user consents to the cost; a free run needs no consent."""
    if yes or not offering.needs_consent:
        return
    if not sys.stdin.isatty():
        raise Refused(f"{offering.line()}: not confirmed", "spend it with --yes, look at it with --dry-run")
    if not ask("measure?"):
        raise Refused("not confirmed: nothing was started")


def _watcher(campaign: "Campaign", prepared: "Prepared", output: str, more: bool) -> "ProgressReporter":
    from fogspec.bench import progress

    body, budget_usd, now_s = prepared.plan.spec, campaign.config.budget_usd, campaign.clock.now_s
    if output == "json":
        return progress.Events(say, progress.Totals(prepared.todo, budget_usd, now_s, more))
    if sys.stderr.isatty() and not is_quiet():
        from fogspec.bench.live_table import LiveTable

        return LiveTable(prepared.todo, body.requests, budget_usd, now_s, warmup=body.warmup, more=more)
    return progress.Lines(note, progress.Totals(prepared.todo, budget_usd, now_s, more))


def _report(prepared: "Prepared", benched: "BenchResult", output: str) -> None:
    from fogspec.base.clouds import quota_command
    from fogspec.bench import progress
    from fogspec.results.resources import doubts_of, use_line
    from fogspec.results.schema import is_final, own_records
    from fogspec.results.standing import carried_text

    layout, results = prepared.layout, benched.results
    if output == "json":
        from fogspec.base.quantities import as_numbers

        say_json({"kind": results.kind, "name": layout.name, **as_numbers(results.spec)}, indent=None)
        return
    for record in results.spec.samples:
        say(f"  {record.id}: {progress.outcome(record)}")
        if record.resources is not None:
            say(f"    resources: {use_line(record.resources)}")
        for text in doubts_of(record) if record.state == "ok" else ():
            say(f"    warning: {text}")
        if record.state != "ok" and record.id in benched.folders:
            say(f"    logs: {benched.folders[record.id]}")
        if record.reason == "quota" and (listed := quota_command(record.machine.infra)) is not None:
            say(f"    quota: {listed} lists it; request a higher one, or measure smaller machines")
        if record.state != "ok" and is_final(record):
            words = ("fogspec", "bench", layout.spec, "--runner", results.spec.runner, "--only", record.id)
            say(f"    again: {shell_command(*words)}")
    if benched.confirmed is not None:
        say(f"{carried_text((results.spec.carried or [])[-1], len(own_records(results.spec.samples)))}")
    if results.spec.sampling is not None and results.spec.sampling.stop_reason is not None:
        say(f"sampling ended: {results.spec.sampling.stop_reason}")
    say(f"results   {layout.results}")
    if any(record.state == "ok" for record in results.spec.samples):
        say_next(next_command("compile", layout.spec))
