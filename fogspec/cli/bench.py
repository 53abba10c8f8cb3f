"""Implement `fogspec bench`: measure the samples of the plan."""

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.console import ask, is_quiet, note, say, say_json, say_on
from fogspec.base.errors import FogspecError, InvalidInput, OutOfDate, Refused, UsageError
from fogspec.base.text import shell_command
from fogspec.cli.next_steps import next_command, same_command, say_next
from fogspec.cli.options import (
    SPEC,
    Dollars,
    applications_of,
    check_image,
    require_ready,
    unmet,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from fogspec.backends.protocol import SampleBackend
    from fogspec.base.yaml.positions import Path as Steps
    from fogspec.bench.campaign import Campaign
    from fogspec.bench.confirm import Expected
    from fogspec.bench.prepare import Prepared
    from fogspec.bench.progress import ProgressReporter
    from fogspec.bench.quote import Quote
    from fogspec.bench.run import BenchResult, Lease
    from fogspec.catalog.table import Catalog
    from fogspec.compile.inputs import Inputs
    from fogspec.language.loader import LoadedSpec, SourceFile
    from fogspec.results.schema import Measured

RUNNERS = ["local", "skypilot"]
FIX = "name what the node reports, or correct the node"


@click.command()
@SPEC
@click.option(
    "--runner",
    "runner_name",
    type=click.Choice(RUNNERS),
    help="where to measure; local: shapes of this host  [default: by the machines of the plan]",
)
@click.option("--only", metavar="ID,…", default="", help="measure only these samples, again if they have a result")
@click.option(
    "--all", "everything", is_flag=True, help="measure all samples after a change, not the chosen machine first"
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
@click.option(
    "--dry-run", is_flag=True, help="check what it requires, show what would be measured and what it costs, and stop"
)
@click.option("-o", "--output", type=click.Choice(["text", "json"]), default="text", help="output format")
def command(runner_name: str | None, **options: Any) -> None:
    """Measure the samples of APP that have no result yet.

    APP is a name or a spec. After a change, the chosen machine is measured once more: if it agrees with the older results,
    they stay valid. Resumes where an earlier bench stopped: finished samples are not measured again, except failures that
    cost nothing; machines that were left running are torn down. Results are written after every sample. The first Ctrl-C
    stops cleanly, the second at once.
    """
    unmet = partial(_unmet, runner=runner_name, output=options["output"])
    measure(partial(_backend, name=runner_name), unmet=unmet, **options)


def measure(
    backend_of: "Callable[[Prepared], SampleBackend]",
    *,
    spec: str,
    only: str,
    everything: bool,
    at_once: int | None,
    resume: bool,
    max_usd: float | None,
    yes: bool,
    dry_run: bool,
    output: str,
    files: bool = True,
    unmet: "Callable[[list[LoadedSpec], dict[Path, SourceFile]], bool] | None" = None,
) -> None:
    """Measure the samples that have no result with the backend that `backend_of` returns for each application.

    `unmet` prints what `--dry-run` requires, and tells whether something is missing. Without `files`, those that the spec
    names need not be there. Raise as `fogspec bench` documents its exit codes.
    """
    from fogspec.backends.protocol import Costs
    from fogspec.bench.confirm import confirming
    from fogspec.bench.prepare import prepare
    from fogspec.bench.quote import Quote, check_prices
    from fogspec.bench.run import BenchOptions, bench
    from fogspec.bench.settle import settling
    from fogspec.catalog.table import each_in_its_unit
    from fogspec.compile.inputs import Inputs

    names = [name.strip() for name in only.split(",") if name.strip()]
    if everything and names:
        raise UsageError("--all and --only exclude each other", "--all measures all samples")
    unusable, refuted, measures = [], [], False
    applications = applications_of(spec)
    _check_measured(applications)
    known: dict[Path, SourceFile] = {}  # that the requirements read
    wanting = dry_run and unmet is not None and unmet(applications, known)
    require_ready(applications, started=True, files=files)
    planned = _planned(applications) if dry_run else applications
    for inputs in each_in_its_unit(Inputs.load([], each=True, loaded=planned, known=known)):
        one, prepared = inputs.spec, prepare(inputs, names)
        backend, expected = backend_of(prepared), None
        if not everything and not names:
            prepared, expected = confirming(prepared, inputs, backend.name)
            prepared = settling(prepared, inputs)
        # Machines of a cloud do not slow one another down; jobs on this computer do.
        raised = backend.costs is Costs.REAL
        backend.at_once = min(at_once or backend.at_once, 64 if raised else backend.at_once)
        _check_place(prepared, backend)
        offering = Quote.of(prepared, backend, max_usd, once_more=expected is not None)
        _offer(prepared, backend, offering, expected)
        catalog, prices = _catalogs(inputs, prepared, backend)
        if prices is not None:
            check_prices(prepared.todo, prices, shell_command("fogspec", "compile", prepared.layout.spec))
        if dry_run:
            measures |= bool(offering.todo) or offering.adaptive
            say(*(offering.lines() if output == "text" else []))
            continue
        _check_needed(prepared, backend)
        if places := {sample.machine.infra for sample in prepared.todo}:
            backend.check_access(places)
        _confirm(offering, yes)
        library = inputs.measured.library if catalog is not None else None
        terms = BenchOptions(max_usd, resume, catalog, prices, library, expected)
        watcher = partial(_watcher, prepared=prepared, output=output, more=offering.adaptive)
        benched = bench(prepared, backend, watcher, terms, _lease(backend))
        _report(one, prepared, benched, output)
        compared = benched.compared
        if not (compared.decided if compared else any(one.state == "ok" for one in benched.results.spec.samples)):
            unusable.append(prepared.layout.name)
        elif compared and compared.confirmed is None:
            refuted.append(prepared.layout.name)
    if wanting:
        raise click.exceptions.Exit(1)
    if dry_run and output == "text":
        say_next(same_command(without="dry_run") if measures else next_command("compile", applications[0].path))
    if unusable:
        raise InvalidInput(
            f"{', '.join(unusable)}: no sample could be measured", "the lines above say why, and where the logs are"
        )
    _require_confirmed(refuted)


def _unmet(loaded: "list[LoadedSpec]", known: "dict[Path, SourceFile]", runner: str | None, output: str) -> bool:
    """Print the requirements; return whether one is not met."""
    from fogspec.base.clouds import LOCAL
    from fogspec.deploy.checks import Stage

    places = set[str]()
    for spec in (one.application.spec for one in loaded if runner != "local"):
        listed = spec.benchmark.machines
        if not listed or any(not name.startswith(f"{LOCAL}/") for name in listed):
            places |= set(spec.infra)
    return unmet(loaded, Stage.BENCH, places, output, known=known)


def _planned(loaded: "list[LoadedSpec]") -> "list[LoadedSpec]":
    """Return the applications that have a plan."""
    return [one for one in loaded if one.layout.files.exists(one.layout.plan)]


def _require_confirmed(refuted: "Sequence[str]") -> None:
    """Raise OutOfDate for applications whose older results were not confirmed."""
    if refuted:
        raise OutOfDate(
            f"not confirmed: {', '.join(refuted)}: the older results stay stale", "the next bench measures the others"
        )


def _offer(prepared: "Prepared", backend: "SampleBackend", offering: "Quote", expected: "Expected | None") -> None:
    """Say what would be measured, what it costs, and what becomes of the results on disk."""
    from fogspec.bench.run import without_image

    tell = partial(say, err=True) if offering.needs_consent else note  # what money is asked for is always said
    lines = [
        *([] if expected is None else [expected.line, "--all measures all samples, without this comparison"]),
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
        kept = f"they are kept in a folder {prepared.layout.name}.old-… beside it"
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


def _backend(prepared: "Prepared", name: str | None) -> "SampleBackend":
    from fogspec.backends.registry import sample_backend

    local = all(sample.machine.is_local for sample in prepared.plan.spec.samples)
    backend: SampleBackend = sample_backend(name or ("local" if local else "skypilot"))()
    return backend


def _check_place(prepared: "Prepared", backend: "SampleBackend") -> None:
    """Raise Refused if a local runner would measure cloud machines, whose names and prices its results would carry."""
    elsewhere = [s.machine for s in prepared.todo if not s.machine.is_local]
    if backend.name == "local" and elsewhere:
        raise Refused(
            f"{prepared.layout.name}: {elsewhere[0].infra} {elsewhere[0].instance} cannot be measured on this machine",
            "to measure here, list shapes such as local/2cpu-4gib under spec.benchmark.machines and compile again",
        )


def _check_needed(prepared: "Prepared", backend: "SampleBackend") -> None:
    """Raise FogspecError for missing secrets and a missing image, before a machine is paid for."""
    from fogspec.base.redaction import check_set
    from fogspec.language.lock_io import read_pins
    from fogspec.language.lockfile import image_named, pinned

    if backend.costs != "recorded":
        check_set(prepared.application.spec.secrets if prepared.todo else ())
    if backend.costs == "real" and prepared.todo:
        exact = pinned(prepared.application, read_pins(prepared.layout))
        check_image(image_named(exact), prepared.application.spec, measures=True)


def _catalogs(
    inputs: "Inputs", prepared: "Prepared", backend: "SampleBackend"
) -> "tuple[Catalog | None, Catalog | None]":
    """Return the catalog for an adaptive campaign and the catalog of current prices; None if it is not needed.

    Raise OutOfDate if the plan was compiled from another catalog.
    """
    from fogspec.catalog.sources import load_catalog
    from fogspec.compile.inputs import clouds_of

    real, adaptive = backend.costs == "real", prepared.plan.spec.sampler == "adaptive"
    if not real and not adaptive:
        return None, None
    if inputs.refused is not None:
        raise inputs.refused
    catalog = inputs.catalog
    if adaptive and catalog.about.digest != prepared.plan.spec.catalog.digest:
        compiling = shell_command("fogspec", "compile", prepared.layout.spec)
        raise OutOfDate(
            f"{prepared.layout.plan} was compiled from another catalog: {prepared.plan.spec.catalog.source}", compiling
        )
    if not real:
        return catalog, None
    try:
        prices = load_catalog("skypilot", clouds_of(inputs.spec))
    except FogspecError as unavailable:
        note(f"prices are compared with {catalog.about.source}, not with SkyPilot's own: {unavailable.message}")
        prices = catalog
    return catalog if adaptive else None, prices


def _confirm(offering: "Quote", yes: bool) -> None:
    """Raise Refused unless the user consents to the cost; a free run needs no consent."""
    if yes or not offering.needs_consent:
        return
    if not sys.stdin.isatty():
        raise Refused(f"{offering.line()}: not confirmed", "spend it with --yes, look at it with --dry-run")
    if not ask("measure?"):
        raise Refused("not confirmed: nothing was started")


def _lease(backend: "SampleBackend") -> "Lease":
    """Return the lease of a bench: real money is spent by one command at a time, wherever clones share the state."""
    from fogspec.backends.protocol import Costs
    from fogspec.base.locks import application_lock
    from fogspec.deploy.shared_state import holding
    from fogspec.deploy.state import SystemWallClock

    if backend.costs is not Costs.REAL:
        return application_lock
    return lambda layout, what: holding(layout, what, SystemWallClock(), say_on)


def _watcher(campaign: "Campaign", prepared: "Prepared", output: str, more: bool) -> "ProgressReporter":
    from fogspec.bench import progress

    body, budget_usd, now_s = prepared.plan.spec, campaign.config.budget_usd, campaign.clock.now_s
    if output == "json":
        return progress.Events(partial(say_json, indent=None), progress.Totals(prepared.todo, budget_usd, now_s, more))
    if sys.stderr.isatty() and not is_quiet():
        from fogspec.bench.live_table import LiveTable

        return LiveTable(prepared.todo, body.requests, budget_usd, now_s, warmup=body.warmup, more=more)
    return progress.Lines(note, progress.Totals(prepared.todo, budget_usd, now_s, more))


def _fix(one: "LoadedSpec", record: "Measured") -> list[str]:
    """Return what to set where in the spec, or to correct, if the node did not report what that expects."""
    import re

    spec, found = one.application.spec, list[str]()
    for text in ", ".join(re.findall(r"no parameter (.*?): ROS 2", record.detail or "")).split(", "):
        undeclared, _, near = text.rstrip(")").partition(" (there is ")
        for steps, span in one.spans.items() if undeclared else ():
            at = steps.index("parameters") + 1 if "parameters" in steps else len(steps)
            if ".".join(map(str, steps[at:])) == undeclared:
                fix = f"write {near}, or declare it in the node" if near else "declare it in the node, or remove it"
                found.append(f"    fix: {span.path}:{span.line}:{span.column}: {fix}")
    names: list[Steps] = [("spec", "metrics", name) for name in spec.metrics]
    names += [("spec", "benchmark", "scenarios", name) for name in spec.benchmark.scenarios]
    for *above, name in [*names, ("spec", "probe")] if record.reason == "not_reported" else ():
        topic = re.escape(spec.metrics[str(name)].topic or "\0") if above[-1] == "metrics" else "\0"
        missing = rf"no \w+ of \w+ {name}\b.*?: (?:the node reported (\w+)(?:;|$))?|no node publishes .*{topic}\b"
        reported = re.search(missing, record.detail or "")
        if reported or (name == "probe" and not found):
            span, known = one.spans[*above, name], reported and reported[1] and above[-1] == "metrics"
            fix = f"set spec.metrics.{name}.callback: {reported[1]}" if reported and known else FIX
            found.append(f"    fix: {span.path}:{span.line}:{span.column}: {fix}")
    return found


def _ways_on(record: "Measured", prepared: "Prepared", runner: str, done: bool) -> list[str]:
    """Return how to measure again what failed, and how to do without a machine that is unavailable."""
    from fogspec.base.units import dollars
    from fogspec.results.schema import UNAVAILABLE, is_final

    spec, missing = prepared.layout.spec, record.reason in UNAVAILABLE and not done
    if not (is_final(record) or missing):
        return []
    # What corrects it changes the spec or a file that is sent, and so the plan.
    first = f"{shell_command('fogspec', 'compile', spec)}; " if record.reason == "not_reported" else ""
    kept = f"kept, it cost {dollars(record.spent)}; " if record.spent and done else ""
    ways = [
        f"    {kept}again: {first}{shell_command('fogspec', 'bench', spec, '--runner', runner, '--only', record.id)}"
    ]
    if missing:
        ways.append(f"    without it: {shell_command('fogspec', 'compile', spec, '--partial')}")
    return ways


def _where_to_look(record: "Measured") -> "Iterator[str]":
    """Yield what lists the limit that a machine met."""
    from fogspec.base.clouds import OwnEnd, cloud_of, quota_command

    if record.reason == "quota" and (listed := quota_command(record.machine.infra)) is not None:
        yield f"    quota: {listed} lists it; request a higher one, or measure smaller machines"
    if record.reason == "capacity" and cloud_of(record.machine.infra).own_end is OwnEnd.POD_DEADLINE:
        yield "    shape: a pod gets what its node allocates, less than the node has: kubectl describe nodes lists it"


def _report(one: "LoadedSpec", prepared: "Prepared", benched: "BenchResult", output: str) -> None:
    from fogspec.bench import progress
    from fogspec.language.warned import sentence
    from fogspec.results.resources import doubts, use_line
    from fogspec.results.schema import completed
    from fogspec.results.standing import carried_warning

    layout, results, compared = prepared.layout, benched.results, benched.compared
    if output == "json":
        from fogspec.base.quantities import as_numbers

        say_json(
            {"kind": "Results", "name": layout.name, "spent": results.spec.spent, **as_numbers(results.spec)},
            indent=None,
        )
        return
    failed = [] if compared is None or compared.failed is None else [compared.failed]
    for record in (*results.spec.samples, *failed):
        say(f"  {record.id}: {progress.outcome(record, one.application.spec.constraints.statistic)}")
        if record.resources is not None:
            say(f"    resources: {use_line(record.resources)}")
        for doubt in doubts(record):
            say(f"    warning: {sentence(doubt)}")
        if record.state != "ok" and record.id in benched.folders:
            say(f"    logs: {benched.folders[record.id]}")
        say(*_where_to_look(record), *_fix(one, record))
        if record.state != "ok" and record not in failed:
            say(*_ways_on(record, prepared, results.spec.runner, record.id in completed(results)))
    if left := {sample.id for sample in prepared.todo} - {record.id for record in results.spec.samples}:
        say(f"not measured: {', '.join(sorted(left))}")
        if benched.halted:
            say(
                "  no more were started, for they would end alike: correct what is said above, and run the command again"
            )
    if compared is not None and compared.confirmed is not None:
        say(sentence(carried_warning((results.spec.carried or [])[-1], len(results.spec.samples))))
    if results.spec.sampling is not None and results.spec.sampling.stop_reason is not None:
        say(f"sampling ended: {results.spec.sampling.stop_reason}")
    say(f"results   {layout.results}")
    say_next(_following(prepared, benched))


def _following(prepared: "Prepared", benched: "BenchResult") -> str | None:
    """Return what comes next: the same command for the other samples if the older results are not confirmed."""
    if (compared := benched.compared) is not None and compared.confirmed is None:
        return same_command(without="yes") if compared.decided else None
    measured = any(record.state == "ok" for record in benched.results.spec.samples)
    return next_command("compile", prepared.layout.spec) if measured else None
