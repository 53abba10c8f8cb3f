"""The tasks of a campaign, and the batches of an adaptive one: recorded, compiled, then measured."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.base.layout import Layout
from fogspec.bench.prepare import sample_task
from fogspec.bench.results_file import ResultsFile
from fogspec.bench.types import SampleTask
from fogspec.catalog.filters import Filtered, offers_for
from fogspec.catalog.table import Catalog
from fogspec.choice.next_samples import next_samples
from fogspec.compile.agent_archive import agent_archive
from fogspec.compile.plan_files import plan_file, with_tasks
from fogspec.language.fingerprints import measured_record
from fogspec.language.lock_io import files_sent, read_pins
from fogspec.language.lockfile import pinned
from fogspec.language.schema import Application
from fogspec.numerics.priors import PriorData
from fogspec.plan.initial_batch import NextBatch
from fogspec.plan.reuse import limits_of, plan_from_campaign, should_resume
from fogspec.plan.schema import Batch, Plan, Sample, Sampling, next_on
from fogspec.results.arrivals import arrivals_in
from fogspec.results.requests import RecordRules

MAX_FAILED_BATCHES = 2  # without one valid sample, after which sampling ends
FIRST = "the cheapest machines"


@dataclass(slots=True)
class Tasks:
    """The tasks of the plan's samples; `known` are tasks on disk, by the id of their sample."""

    layout: Layout
    plan: Plan
    known: dict[str, SampleTask]

    def task(self, sample: Sample) -> SampleTask | None:
        """Return the task of a sample; None if the plan does not have it."""
        return self.known.get(sample.id)

    def adopt(self, application: Application, plan: Plan, files: Mapping[Path, bytes]) -> None:
        """Continue with another plan of the application, whose image is pinned, and write its files."""
        for path, content in files.items():
            if not self.layout.files.is_file(path) or self.layout.files.head(path, len(content) + 1) != content:
                self.layout.files.write(path, content)
        self.plan, sent = plan, {**files, self.layout.agent: agent_archive()}
        for sample in plan.spec.samples:
            self.known[sample.id] = sample_task(application, plan, sample, self.layout, sent)


@dataclass(slots=True, kw_only=True)
class AdaptiveSampling:
    """The decisions of an adaptive campaign; each is in the results before it is carried out."""

    application: Application
    layout: Layout
    catalog: Catalog
    tasks: Tasks
    sink: ResultsFile
    library: PriorData | None = None
    filtered: Filtered = field(init=False)

    def __post_init__(self) -> None:
        self.filtered = offers_for(self.catalog, self.application.spec)

    def begin(self) -> list[Sample]:
        """Record the first batch, or resume with the recorded ones; return the samples of all of them."""
        if self.sink.sampling is None:
            body = self.tasks.plan.spec
            samples = [sample.model_copy(update={"task": None}) for sample in body.samples]
            self._record([Batch(reason=FIRST, samples=samples)])
        self._write_plan()
        return [sample for batch in self._batches() for sample in batch.samples]

    def next(self, left_usd: float) -> list[Sample]:
        """Return the samples of the next batch, for at most `left_usd` in total; none when sampling has ended."""
        before = self.sink.sampling
        if before is None or (before.stop_reason is not None and not should_resume(self.application, before)):
            return []
        if len(before.batches) >= MAX_FAILED_BATCHES and not any(
            one.state == "ok" for one in self.sink.samples.values()
        ):
            return []
        found = self._next_samples(left_usd)
        offers = self.filtered.offers
        taken = {one.id: one.machine for batch in self._batches() for one in batch.samples}
        taken |= {one.id: one.machine for one in self.sink.samples.values()}
        samples = list[Sample]()
        for number, (row, why) in enumerate(zip(found.rows, found.reasons, strict=True)):
            one = next_on(offers.machine(row), why, taken)
            samples.append(one.model_copy(update={"decided_above": found.decided_above(number)}))
            taken[one.id] = one.machine
        batches = [*self._batches(), *([Batch(reason=found.reason, samples=samples)] if samples else [])]
        out_of_budget = not samples and math.isfinite(left_usd) and bool(self._next_samples(math.inf).rows)
        self._record(batches, None if samples else found.reason, out_of_budget)
        self._write_plan()
        return samples

    def _next_samples(self, left_usd: float) -> NextBatch:
        offers, benchmark, load = (
            self.filtered.offers,
            self.application.spec.benchmark,
            self.application.spec.objective.load,
        )
        records, rules = list(self.sink.samples.values()), RecordRules.of(self.application)
        return next_samples(
            self.application,
            offers,
            records,
            arrivals={} if load is None else arrivals_in(records, self.layout.results, rules, load.rate),
            usd_per_sample=self.tasks.plan.spec.commitment.usd(offers),
            left_usd=left_usd,
            library=self.library,
            batch=benchmark.batch_size,
        )

    def _batches(self) -> Sequence[Batch]:
        return self.sink.sampling.batches if self.sink.sampling is not None else ()

    def _record(self, batches: Sequence[Batch], ended: str | None = None, out_of_budget: bool = False) -> None:
        spec = self.application.spec
        sampling = Sampling(
            hardware=spec.hardware.search_space,
            infra=spec.infra,
            limits_digest=limits_of(self.application),
            batches=list(batches),
            stop_reason=ended,
            out_of_budget=out_of_budget,
        )
        self.sink.decide(sampling)

    def _write_plan(self) -> None:
        """Write the plan as compile does from the results."""
        sampling = self.sink.sampling
        if sampling is None:
            return
        layout = self.layout
        record = measured_record(self.application, read_pins(layout), files_sent(self.application, layout))
        bare = plan_from_campaign(self.application, self.catalog, sampling, record)
        exact = pinned(self.application, read_pins(layout))
        plan, files = with_tasks(exact, bare, layout)
        files[layout.plan] = plan_file(plan, layout)
        self.tasks.adopt(exact, plan, files)
