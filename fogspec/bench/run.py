"""One benchmark from start to end: locked, journaled, interruptible, and reported."""

import contextlib
import math
import secrets
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from fogspec.backends.protocol import Costs, SampleBackend, no_access
from fogspec.backends.registry import owner_of
from fogspec.base import digest
from fogspec.base.clock import SystemClock
from fogspec.base.clouds import LOCAL, cloud_name
from fogspec.base.console import GONE, say_on
from fogspec.base.errors import Busy, CloudError, FogspecError, Interrupted, InvalidInput, Refused
from fogspec.base.layout import Layout
from fogspec.base.locks import application_lock
from fogspec.base.redaction import redact_files
from fogspec.base.signals import Interrupt, interruptible
from fogspec.base.text import shell_command
from fogspec.base.units import dollars, format_money
from fogspec.bench.adaptive import AdaptiveSampling, Tasks
from fogspec.bench.campaign import Campaign
from fogspec.bench.claim import ClaimingBackend
from fogspec.bench.confirm import ConfirmingFile, Expected
from fogspec.bench.journal import Journal
from fogspec.bench.orphans import adopt_orphans, adopt_returned
from fogspec.bench.prepare import Prepared
from fogspec.bench.progress import FINAL, ProgressReporter
from fogspec.bench.quote import check_prices
from fogspec.bench.results_file import ResultsFile, set_aside
from fogspec.bench.retry import overdrawn
from fogspec.bench.types import CampaignConfig, Event
from fogspec.catalog.table import Catalog
from fogspec.language.fingerprints import files_of_record
from fogspec.language.lock_io import snapshot
from fogspec.language.lockfile import image_named
from fogspec.language.schema import Application
from fogspec.numerics.priors import PriorData
from fogspec.plan.budget import ceil_cents
from fogspec.plan.schema import Sample
from fogspec.results.folded import cost_usd
from fogspec.results.io import aside
from fogspec.results.requests import RecordRules
from fogspec.results.schema import Results, completed
from fogspec.results.standing import carried_on


class Held(Protocol):
    """A lease that other computers see: another command may take it over while this one has no contact."""

    overtaken: bool

    def lost(self) -> Busy:
        """Return the error that ends this command then."""
        ...


Lease = Callable[[Layout, str], AbstractContextManager[Held | None]]
Watch = Callable[[Campaign], ProgressReporter]


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """The options of a bench besides its plan.

    It spends at most `max_usd`; with `resume` it takes down machines that no journal here lists. An adaptive
    campaign samples machines of `catalog`, with the prior data of `library`; without a catalog it measures only the recorded
    batches. Nothing is started that is more expensive in `prices` than in its plan. With what the older results have
    `expected` of the one sample to measure, they count on if it agrees.
    """

    max_usd: float | None = None
    resume: bool = False
    catalog: Catalog | None = None
    prices: Catalog | None = None
    library: PriorData | None = None
    expected: Expected | None = None


@dataclass(frozen=True, slots=True)
class BenchResult:
    """The results on disk, the directories with the logs of the samples that were measured now, and what was `compared`.

    It was `halted` where the samples that ended show a mistake that the others would repeat.
    """

    results: Results
    folders: dict[str, Path]
    compared: ConfirmingFile | None = None
    halted: bool = False


@dataclass(slots=True)
class _Bench:
    """The parts of one bench; `left` gets the names of machines that could not be verified gone."""

    prepared: Prepared
    backend: SampleBackend
    options: BenchOptions
    interrupt: Interrupt
    lease: Held | None
    left: list[str] = field(default_factory=list)

    @property
    def stopping(self) -> bool:
        """Whether to end cleanly: the user requested it, or another command took over the lease."""
        self.interrupt.asked |= self.lease is not None and self.lease.overtaken
        return self.interrupt.asked


def bench(
    prepared: Prepared,
    backend: SampleBackend,
    watch: Watch,
    options: BenchOptions | None = None,
    lease: Lease = application_lock,
) -> BenchResult:
    """Measure the samples of the plan that are still to do, while the `lease` of the application is held.

    Raise Busy while another bench, apply or down of this application runs, Refused if its journal names machines of another
    application, OutOfDate if results changed meanwhile,
    CloudError for machines that could not be verified gone, Interrupted after Ctrl-C, InvalidInput for a disk
    that cannot be written; results are on disk in every case.
    """
    layout, left = prepared.layout, list[str]()
    again = f"the same command resumes where this one stopped; fogspec down {layout.name} tears everything down"
    try:
        with lease(layout, f"bench of {layout.name}") as held, interruptible() as interrupt:
            prepared.check_current()
            result = _measure(_Bench(prepared, backend, options or BenchOptions(), interrupt, held, left), watch)
    except KeyboardInterrupt:
        now = "interrupted at once" if left else "interrupted at once: nothing runs any more"
        raise Interrupted(now, *_may_run(left, backend), again) from None
    except BrokenPipeError:
        raise
    except OSError as problem:
        message = f"{problem.filename or layout.state}: {problem.strerror or problem}"
        raise InvalidInput(message, *_may_run(left, backend), again) from None
    except FogspecError as failed:
        failed.hints = (*failed.hints, *_may_run(left, backend), *([again] if left else []))
        raise
    except Exception:
        if left:
            say_on(*_may_run(left, backend), again)
        raise
    if left:
        raise CloudError("these machines could not be verified gone", *_may_run(left, backend), again)
    if held is not None and held.overtaken:
        raise held.lost()
    if interrupt.asked:
        kept = f"{len(completed(result.results))} samples are done and kept in {layout.results}"
        raise Interrupted("interrupted: nothing runs any more", kept, again)
    return result


def _may_run(left: Sequence[str], backend: SampleBackend) -> list[str]:
    """Return a line for each machine that may still run, with the command that ends it without fogspec."""
    by_hand = ", by hand: sky down {}" if backend.name == "skypilot" else ""
    return [f"may still run: {name}{by_hand.format(name)}" for name in left]


def _measure(one: _Bench, watch: Watch) -> BenchResult:
    """Run the campaign; `left` is kept up to date also when this raises."""
    layout = one.prepared.layout
    journal = Journal(layout.journal, files=layout.files)
    folders = dict[str, Path]()
    try:
        campaign, sink, tasks = _campaign(one, journal)
        with watch(campaign) as reporter:
            campaign.report = _heard(reporter, one.interrupt, folders)
            starts = bool(one.prepared.todo) or one.prepared.plan.spec.sampler == "adaptive"
            adopt_orphans(campaign, one.prepared.plan.spec.samples, one.options.resume, starts)
            running = campaign.recover()
            if not campaign.running:
                _check_affordable(campaign, one.prepared)
            _run(one, campaign, sink, tasks, running)
            if not campaign.left:
                # A cloud's list lags behind: what had just been started elsewhere is on it by now.
                adopt = partial(adopt_orphans, samples=one.prepared.plan.spec.samples, resume=True)
                (adopt if one.options.resume else adopt_returned)(campaign)
                campaign.recover()
                campaign.run([])
        return BenchResult(
            sink.results(), folders, sink if isinstance(sink, ConfirmingFile) else None, campaign.is_halted()
        )
    except KeyboardInterrupt:
        one.left[:] = journal.state.open
        raise
    finally:
        journal.close()
        if not journal.state.open:
            with contextlib.suppress(OSError):
                layout.files.remove_tree(layout.sent)


def _heard(report: Callable[[Event], None], interrupt: Interrupt, folders: dict[str, Path]) -> Callable[[Event], None]:
    """Return the report, which asks for a clean stop once it cannot be read: its terminal or pipe was closed.

    `folders` gets each sample's folder, out of whose files secrets are taken once the attempt has ended.
    """

    def tell(event: Event) -> None:
        if event.folder is not None:
            folders[event.sample.id] = event.folder
            if event.kind in FINAL:
                redact_files(event.folder)
        try:
            report(event)
        except OSError as lost:
            if lost.errno not in GONE:
                raise
            interrupt.asked = True

    return tell


def _check_affordable(campaign: Campaign, prepared: Prepared) -> None:
    """Raise Refused if the budget is spent already: no sample that is to be measured fits into what is left."""
    budget, spent_usd = prepared.application.spec.benchmark.budget, campaign.journal.state.spent_usd
    if campaign.backend.costs != Costs.REAL or budget is None or not prepared.todo:
        return
    least_usd = min(map(campaign.most_usd, prepared.todo))
    if overdrawn(spent_usd + least_usd, budget):
        needs = f"the next sample may cost {dollars(least_usd)}"
        raise Refused(
            f"{dollars(spent_usd)} of the budget of {dollars(budget)} is spent, and {needs}",
            "the budget is the application's: what was measured before a change of the spec counts",
            f"to allow more, raise spec.benchmark.budget to at least {format_money(ceil_cents(spent_usd + least_usd))}",
        )


def _run(one: _Bench, campaign: Campaign, sink: ResultsFile, tasks: Tasks, running: set[str]) -> None:
    """Measure the samples of the plan that do not run already, and in an adaptive campaign the batches after that."""
    prepared, options = one.prepared, one.options
    todo, sampling = list(prepared.todo), None
    adaptive = prepared.plan.spec.sampler == "adaptive" and not prepared.only
    if adaptive and options.catalog is not None and not one.interrupt.asked:
        sampling = AdaptiveSampling(
            application=prepared.application,
            layout=prepared.layout,
            catalog=options.catalog,
            tasks=tasks,
            sink=sink,
            library=options.library,
        )
        todo = _unmeasured(sampling.begin(), sink)
    if isinstance(sink, ConfirmingFile) and sink.decided:  # by a sample that an earlier bench measured
        todo = []
    campaign.run([sample for sample in todo if sample.id not in running])
    if campaign.denied is not None:
        raise no_access(campaign.denied, booked_usd=campaign.denied_usd, verified=not campaign.left)
    while sampling is not None and not one.interrupt.asked and not campaign.left and not campaign.is_halted():
        batch = sampling.next(_left_usd(campaign))
        if not batch:
            return
        if options.prices is not None:
            check_prices(batch, options.prices, shell_command("fogspec", "compile", prepared.layout.spec))
        campaign.run(batch)
        if campaign.denied is not None:
            raise no_access(campaign.denied, booked_usd=campaign.denied_usd, verified=not campaign.left)


def _unmeasured(samples: list[Sample], sink: ResultsFile) -> list[Sample]:
    measured = completed(sink.results())
    return [sample for sample in samples if sample.id not in measured]


def _left_usd(campaign: Campaign) -> float:
    """Return what is left of the budget; infinity without one."""
    state, budget = campaign.journal.state, campaign.config.budget_usd
    return math.inf if budget is None else budget - state.spent_usd - state.committed_usd


def _campaign(one: _Bench, journal: Journal) -> tuple[Campaign, ResultsFile, Tasks]:
    prepared, backend = one.prepared, one.backend
    layout, body, spec = prepared.layout, prepared.plan.spec, prepared.application.spec
    owner = owner_of(layout)
    journal.check_owned(owner)
    layout.files.names(layout.attempts)  # a link there is refused before anything is started
    token = secrets.token_hex(4)
    tree = None
    if backend.costs != Costs.RECORDED:
        tree = snapshot(prepared.application, layout, layout.sent / token, files_of_record(body.inputs))
    made: dict[str, Any] = {
        "layout": layout,
        "inputs": body.inputs,
        "runner": backend.name,
        "source": "; ".join(filter(None, [backend.source, *without_image(prepared.application, backend)])) or None,
    }
    sink = ResultsFile(**made)
    if one.options.expected is not None and prepared.read is not None:
        sink = ConfirmingFile(**made, older=prepared.read, expected=one.options.expected)
        sink.begin(prepared.read)
    if prepared.outdated:
        set_aside(layout)
    sink.before_usd = sink.before_usd or cost_usd(aside(layout), backend.name)
    if prepared.results is not None:
        check_same_runner(prepared.results, backend)
        sink.resume(prepared.results)
        sink.carried = carried_on(prepared.results, prepared.standing.waived)
    tasks = Tasks(layout, prepared.plan, dict(prepared.tasks))
    measured = digest.of_value(body.inputs)  # a sample that still runs from before must have been started for the same
    journal.begin(backend.name, measured, prepared.plan_digest, prepared.spent_usd.get(backend.name, 0.0))
    if prepared.standing.waived and prepared.results is not None:
        sink.write()  # so that what is measured now is not taken for the same as what was
    allowed = None if one.options.max_usd is None else journal.state.spent_usd + one.options.max_usd
    config = CampaignConfig(
        owner=owner,
        measured=measured,
        rules=RecordRules.of(prepared.application),
        budget_usd=min((cap for cap in (spec.benchmark.budget, allowed) if cap is not None), default=None),
        commitment=body.commitment,
        task=tasks.task,
        root=layout.root,
        attempts=layout.attempts,
        token=token,
        tree=tree,
    )
    clock = SystemClock()
    campaign = Campaign(
        config=config,
        backend=ClaimingBackend(
            backend,
            owner=owner,
            directory=layout.attempts,
            token=token,
            ours=lambda: journal.state.open,
            now_s=clock.now_s,
        ),
        journal=journal,
        sink=sink,
        clock=clock,
        stopping=lambda: one.stopping,
        halted=lambda: sink.unheard(prepared.only),
        proven={cloud_name(one.machine.infra) for one in sink.samples.values() if one.state == "ok"},
        left=one.left,
    )
    return campaign, sink, tasks


def without_image(application: Application, backend: SampleBackend) -> list[str]:
    """Return a line for an image that the spec names and this runner does not start; nothing otherwise."""
    image = image_named(application)
    if image is None or backend.name != LOCAL:
        return []
    return [f"without the image {image}: the nodes use what is installed on this host"]


def check_same_runner(results: Results, backend: SampleBackend) -> None:
    """Raise Refused if results of one kind of measurement would be mixed with those of another."""
    if results.spec.samples and results.spec.runner != backend.name:
        raise Refused(
            f"the results there were measured with the runner {results.spec.runner}, not {backend.name}: they are not mixed",
            "move the folder of results away to measure everything again",
        )
