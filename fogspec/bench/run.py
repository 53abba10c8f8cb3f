"""One benchmark from start to end: locked, journaled, interruptible, and reported."""

import math
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.agent.secrecy import Secrets
from fogspec.backends.naming import sample_prefix
from fogspec.backends.protocol import Runner
from fogspec.base import digest
from fogspec.base.clock import SystemClock
from fogspec.base.errors import CloudError, Interrupted, InvalidInput, Refused
from fogspec.base.locks import application_lock
from fogspec.base.signals import Interrupt, interruptible
from fogspec.bench import progress
from fogspec.bench.adaptive import AdaptiveSampling, Tasks
from fogspec.bench.campaign import Campaign
from fogspec.bench.journal import Journal
from fogspec.bench.orphans import adopt_orphans
from fogspec.bench.prepare import Prepared
from fogspec.bench.quote import check_prices
from fogspec.bench.record import Rules
from fogspec.bench.redaction import RedactingProgress
from fogspec.bench.results_file import ResultsFile, set_aside
from fogspec.bench.types import CampaignConfig
from fogspec.catalog.table import Catalog
from fogspec.numerics.priors import Library
from fogspec.plan.reuse import price_rises
from fogspec.plan.schema import Sample, lifetime_s
from fogspec.results.schema import Results, completed
from fogspec.spec import fingerprints
from fogspec.spec.lock_io import read_pins
from fogspec.spec.lockfile import pinned

DEADLINE_BEFORE_END_S = 60.0
Watch = Callable[[Campaign], progress.ProgressReporter]


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What a bench may do beside its plan.

    It spends at most `max_usd`; with `resume` it takes down machines that no journal here knows. An adaptive
    campaign asks for machines of `catalog`, with what the `library` knows of them; without a catalog it measures only
    what was asked for already. Nothing is started that is dearer in `prices` than its plan says.
    """

    max_usd: float | None = None
    resume: bool = False
    catalog: Catalog | None = None
    prices: Catalog | None = None
    library: Library | None = None


@dataclass(frozen=True, slots=True)
class BenchResult:
    """The results as they are on disk, and the folders with the logs of what was measured now, by sample."""

    results: Results
    folders: dict[str, Path]


@dataclass(slots=True)
class _Bench:
    """What one bench works with; `left` gets the names of machines that are not known to be gone."""

    prepared: Prepared
    runner: Runner
    terms: BenchOptions
    interrupt: Interrupt
    left: list[str] = field(default_factory=list)


def bench(prepared: Prepared, runner: Runner, watch: Watch, terms: BenchOptions | None = None) -> BenchResult:
    """Measure what is to be measured.

    Raises Refused while another bench, apply or down of this application runs, OutOfDate where results changed meanwhile,
    CloudError for machines that could not be verified gone, Interrupted when the user stopped it, InvalidInput for a disk
    that cannot be written; results are on disk in every case.
    """
    layout, left = prepared.layout, list[str]()
    again = f"the same command goes on where this one stopped; fogspec down {layout.name} ends everything"
    try:
        with application_lock(layout.state / "lock", f"bench of {layout.name}"), interruptible() as interrupt:
            prepared.check_current()
            benched = _measure(_Bench(prepared, runner, terms or BenchOptions(), interrupt, left), watch)
    except KeyboardInterrupt:
        now = "interrupted at once" if left else "interrupted at once: nothing runs any more"
        raise Interrupted(now, *map("may still run: {}".format, left), again) from None
    except BrokenPipeError:
        raise
    except OSError as problem:
        said = f"{problem.filename or layout.state}: {problem.strerror or problem}"
        raise InvalidInput(said, *map("may still run: {}".format, left), again) from None
    if left:
        raise CloudError("these machines could not be verified gone", *left, again)
    if interrupt.asked:
        kept = f"{len(completed(benched.results))} samples are done and kept in {layout.results}"
        raise Interrupted("interrupted: nothing runs any more", kept, again)
    return benched


def _measure(one: _Bench, watch: Watch) -> BenchResult:
    """Run the campaign; `left` is kept up to date also when this raises."""
    layout = one.prepared.layout
    journal = Journal(layout.state / "journal.jsonl")
    secret = Secrets.of(one.prepared.application.spec.secrets)
    try:
        campaign, ledger, tasks = _campaign(one, journal, secret)
        with watch(campaign) as watcher:
            teller = RedactingProgress(watcher, secret)
            campaign.tell = teller
            starts = bool(one.prepared.todo) or one.prepared.plan.spec.sampler == "adaptive"
            adopt_orphans(campaign, one.prepared.plan.spec.samples, one.terms.resume, starts)
            going_on = campaign.recover()
            _run(one, campaign, ledger, tasks, going_on)
        return BenchResult(ledger.results(), teller.folders)
    except KeyboardInterrupt:
        one.left[:] = journal.book.open
        raise
    finally:
        journal.close()


def _run(one: _Bench, campaign: Campaign, ledger: ResultsFile, tasks: Tasks, going_on: set[str]) -> None:
    """Measure what the plan asks for, and in an adaptive campaign what is asked for after that."""
    prepared, terms = one.prepared, one.terms
    todo = list(prepared.todo)
    adaptive = prepared.plan.spec.sampler == "adaptive" and not prepared.only and terms.catalog is not None
    waves = None
    if adaptive and not one.interrupt.asked:
        assert terms.catalog is not None
        life = campaign.order.lifetime_s
        waves = AdaptiveSampling(
            prepared.application, prepared.layout, terms.catalog, tasks, ledger, life, terms.library
        )
        todo = _unmeasured(waves.begin(), ledger)
    campaign.run([sample for sample in todo if sample.id not in going_on])
    while waves is not None and not one.interrupt.asked and not campaign.left:
        wave = waves.next(_left_usd(campaign))
        if not wave:
            return
        if terms.prices is not None:
            check_prices(wave, terms.prices, f"fogspec compile {prepared.layout.spec}")
        campaign.run(wave)


def _unmeasured(samples: list[Sample], ledger: ResultsFile) -> list[Sample]:
    measured = completed(ledger.results())
    return [sample for sample in samples if sample.id not in measured]


def _substitutes(samples: list[Sample], ledger: ResultsFile, prices: Catalog | None) -> list[Sample]:
    """Those that are not measured yet and cost what the plan says."""
    left = _unmeasured(samples, ledger)
    return left if prices is None else [one for one in left if not price_rises([one], prices)]


def _left_usd(campaign: Campaign) -> float:
    """What the wall still allows."""
    book, budget = campaign.journal.book, campaign.order.budget_usd
    return math.inf if budget is None else budget - book.spent_usd - book.committed_usd


def _campaign(one: _Bench, journal: Journal, secret: Secrets) -> tuple[Campaign, ResultsFile, Tasks]:
    prepared, runner = one.prepared, one.runner
    layout, body, spec = prepared.layout, prepared.plan.spec, prepared.application.spec
    application = fingerprints.measured_digest(prepared.application)
    ledger = ResultsFile(
        layout, application, prepared.plan_digest, runner.name, runner.source, spec.benchmark.budget,
        [sample.id for sample in body.samples], secret.out_of, body.pins or None, body.application.field_digests,
    )  # fmt: skip
    if prepared.outdated:
        set_aside(layout)
    if prepared.results is not None:
        check_same_runner(prepared.results, runner)
        ledger.take(prepared.results)
    tasks = Tasks(pinned(prepared.application, read_pins(layout)), layout, prepared.plan, dict(prepared.tasks))
    # A sample that runs on from before must have been started by a task with the same pins.
    measures = digest.of_value([application, body.pins])
    journal.begin(runner.name, measures, prepared.plan_digest, ledger.spent_usd)
    life = lifetime_s(body.duration, body.setup_timeout)
    walls = [spec.benchmark.budget, None if one.terms.max_usd is None else journal.book.spent_usd + one.terms.max_usd]
    order = CampaignConfig(
        application=measures, rules=Rules.of(prepared.application),
        budget_usd=min((wall for wall in walls if wall is not None), default=None),
        deadline_s=life - DEADLINE_BEFORE_END_S, lifetime_s=life, task=tasks.task, root=layout.root,
        attempts=layout.state / "attempts", prefix=sample_prefix(layout.name), token=secrets.token_hex(4),
        instead=lambda name: _substitutes(tasks.instead(name), ledger, one.terms.prices),
    )  # fmt: skip
    campaign = Campaign(
        order, runner, journal, ledger, SystemClock(), stopping=lambda: one.interrupt.asked, left=one.left
    )
    return campaign, ledger, tasks


def check_same_runner(results: Results, runner: Runner) -> None:
    """Raises Refused when results of one kind of measurement would be mixed with those of another."""
    if results.spec.samples and results.spec.runner != runner.name:
        raise Refused(
            f"the results there were measured with the runner {results.spec.runner}, not {runner.name}: they are not mixed",
            "move the results file away to measure everything anew",
        )
