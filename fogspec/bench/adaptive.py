"""The tasks of a campaign, and the batches of an adaptive one: recorded, compiled, then measured."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fogspec.base import digest
from fogspec.base.layout import Layout
from fogspec.base.units import shown_duration
from fogspec.bench.prepare import against_spec, read_task
from fogspec.bench.results_file import ResultsFile
from fogspec.catalog.filters import Filtered, filter_offers
from fogspec.catalog.table import Catalog
from fogspec.choice.next_samples import next_samples
from fogspec.compile.plan_files import plan_file, task_file, with_substitutes, with_tasks
from fogspec.numerics.priors import PriorData
from fogspec.plan.initial_batch import NextBatch, batch_size
from fogspec.plan.parts import with_parts
from fogspec.plan.reuse import limits_of, plan_from_campaign, should_resume
from fogspec.plan.schema import Batch, Plan, Sample, Sampling, next_on, sample_on
from fogspec.results.schema import Measured, own_records
from fogspec.spec.lock_io import read_pins
from fogspec.spec.lockfile import pinned, pins_of_measurement
from fogspec.spec.schema import Application

MAX_FAILED_BATCHES = 2  # without one valid sample, after which sampling ends
FIRST = "what says most about all machines for its price"


@dataclass(slots=True)
class Tasks:
    """The tasks of the plan's samples and of their substitutes, which are compiled when they are needed.

    `application` is the spec with its pins, `known` are tasks on disk, by the id of their sample.
    """

    application: Application
    layout: Layout
    plan: Plan
    known: dict[str, Mapping[str, Any]]

    def task(self, sample: Sample) -> Mapping[str, Any] | None:
        """Return the task of a sample; None if the plan does not have it."""
        if sample.id not in self.known and any(one.id == sample.id for one in self._substitutes()):
            self._write(sample)
        return self.known.get(sample.id)

    def substitutes(self, sample_id: str) -> list[Sample]:
        """Return the substitutes of a sample."""
        return self._substitutes(sample_id)

    def adopt(self, plan: Plan, files: Mapping[Any, bytes]) -> None:
        """Continue with another plan, and write its files."""
        for path, content in files.items():
            if not self.layout.files.is_file(path) or self.layout.files.read(path) != content:
                self.layout.files.write(path, content)
        self.plan = plan
        for sample in plan.spec.samples:
            self.known[sample.id] = read_task(files[self.layout.task(sample.id)])

    def _substitutes(self, sample_id: str | None = None) -> list[Sample]:
        named = [
            one
            for one in self.plan.spec.substitutes
            if sample_id in (None, one.substitute_for) and against_spec(self.application, one.machine) is None
        ]
        return [sample_on(one.machine, f"instead of {one.substitute_for}: {one.reason}") for one in named]

    def _write(self, sample: Sample) -> None:
        content = task_file(self.application, self.plan, sample, self.layout)
        self.layout.files.write(self.layout.task(sample.id), content)
        self.known[sample.id] = read_task(content)


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
        self.filtered = filter_offers(self.catalog, self.application.spec.hardware, self.application.spec.infra)

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
        taken = {*self.sink.samples, *(sample.id for batch in self._batches() for sample in batch.samples)}
        samples = [
            with_parts(next_on(offers.machine(row), why, taken), offers, found.part_types(offers, number)).model_copy(
                update={"decided_above": found.decided_above(number)}
            )
            for number, (row, why) in enumerate(zip(found.rows, found.reasons, strict=True))
        ]
        batches = [*self._batches(), *([Batch(reason=found.reason, samples=samples)] if samples else [])]
        out_of_budget = not samples and math.isfinite(left_usd) and bool(self._next_samples(math.inf).rows)
        self._record(batches, None if samples else found.reason, out_of_budget)
        self._write_plan()
        return samples

    def _next_samples(self, left_usd: float) -> NextBatch:
        offers, benchmark = self.filtered.offers, self.application.spec.benchmark
        records = list(self.sink.samples.values())
        types = len(np.unique(offers.instance))
        batch = batch_size(benchmark, types, batches=len(self._batches()), samples=len(own_records(records)))
        if not batch:
            return NextBatch((), (), f"the wall time of {shown_duration(benchmark.wall_time or 0.0)} is used up")
        return next_samples(
            self.application,
            offers,
            records,
            usd_per_sample=offers.price_usd_per_hour * self._paid_s / 3600,
            left_usd=left_usd,
            library=self.library,
            batch=batch,
            paid_share=self._paid_share(records),
        )

    @property
    def _paid_s(self) -> float:
        """The longest time that a sample is paid for."""
        return self.tasks.plan.spec.commitment.paid_s

    def _paid_share(self, records: Sequence[Measured]) -> float:
        """Return the share of its longest time that a sample is expected to be paid for: as those measured so far."""
        paid_s = [one.duration for one in own_records(records) if one.state == "ok" and one.duration > 0]
        return min(math.fsum(paid_s) / len(paid_s) / self._paid_s, 1.0) if paid_s else 1.0

    def _batches(self) -> Sequence[Batch]:
        return self.sink.sampling.batches if self.sink.sampling is not None else ()

    def _record(self, batches: Sequence[Batch], ended: str | None = None, out_of_budget: bool = False) -> None:
        spec = self.application.spec
        sampling = Sampling(
            hardware=spec.hardware,
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
        layout, source = self.layout, self.layout.relative(self.layout.spec)
        pins = pins_of_measurement(self.application, read_pins(layout))
        bare = plan_from_campaign(self.application, source, self.catalog, sampling, pins)
        exact = pinned(self.application, read_pins(layout))
        plan, files = with_tasks(exact, with_substitutes(exact, bare, self.filtered), layout)
        files[layout.plan] = plan_file(plan, layout)
        self.tasks.adopt(plan, files)
        self.sink.sample_ids[:] = [sample.id for sample in plan.spec.samples]
        self.sink.plan = digest.of_bytes(files[layout.plan])
        self.sink.write()
