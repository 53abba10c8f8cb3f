"""A campaign's tasks, and in an adaptive one its waves: what is asked for is written down, compiled, and then measured."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fogspec.base import digest
from fogspec.base.files import write_bytes
from fogspec.base.layout import Layout
from fogspec.bench.prepare import read_task
from fogspec.bench.results_file import ResultsFile
from fogspec.catalog.filters import Filtered, filter_offers
from fogspec.catalog.table import Catalog
from fogspec.choice.next_samples import next_samples
from fogspec.compile.compiler import plan_file, task_file, with_substitutes, with_tasks
from fogspec.numerics.priors import Library
from fogspec.plan.initial_batch import NextBatch
from fogspec.plan.reuse import covers, plan_from_campaign
from fogspec.plan.schema import Batch, Plan, Sample, Sampling, next_on, sample_on
from fogspec.spec import fingerprints
from fogspec.spec.lock_io import read_pins
from fogspec.spec.lockfile import pinned, pins_of_measurement
from fogspec.spec.schema import Application

HOPELESS = 2  # waves without one measured machine, after which others are not worth trying
FIRST = "what says most about all machines for its price"


@dataclass(slots=True)
class Tasks:
    """The tasks of the plan's samples, and of machines that take a sample's place, compiled when they are needed.

    `application` is the spec with its pins, `known` are tasks that are on disk, by the id of their sample.
    """

    application: Application
    layout: Layout
    plan: Plan
    known: dict[str, Mapping[str, Any]]

    def task(self, sample: Sample) -> Mapping[str, Any] | None:
        """The task of a sample, None when the plan does not ask for it."""
        if sample.id not in self.known and any(one.id == sample.id for one in self._others()):
            self._write(sample)
        return self.known.get(sample.id)

    def instead(self, sample_id: str) -> list[Sample]:
        """The machines that may take a sample's place."""
        return self._others(sample_id)

    def adopt(self, plan: Plan, files: Mapping[Any, bytes]) -> None:
        """Go on with another plan, whose files these are."""
        for path, content in files.items():
            if not path.is_file() or path.read_bytes() != content:
                write_bytes(path, content)
        self.plan = plan
        for sample in plan.spec.samples:
            self.known[sample.id] = read_task(files[self.layout.task(sample.id)])

    def _others(self, sample_id: str | None = None) -> list[Sample]:
        named = [one for one in self.plan.spec.substitutes if sample_id in (None, one.substitute_for)]
        return [sample_on(one.machine, f"instead of {one.substitute_for}: {one.reason}") for one in named]

    def _write(self, sample: Sample) -> None:
        content = task_file(self.application, self.plan, sample, self.layout)
        write_bytes(self.layout.task(sample.id), content)
        self.known[sample.id] = read_task(content)


@dataclass(slots=True)
class AdaptiveSampling:
    """The decisions of an adaptive campaign. Each is in the results before anything follows from it."""

    application: Application
    layout: Layout
    catalog: Catalog
    tasks: Tasks
    ledger: ResultsFile
    lifetime_s: float
    library: Library | None = None
    admissible: Filtered = field(init=False)

    def __post_init__(self) -> None:
        self.admissible = filter_offers(self.catalog, self.application.spec.hardware, self.application.spec.infra)

    def begin(self) -> list[Sample]:
        """Write the first wave down, or go on with the waves that were asked for before; returns all their samples."""
        if self.ledger.sampling is None:
            body = self.tasks.plan.spec
            samples = [sample.model_copy(update={"task": None}) for sample in body.samples]
            self._decide([Batch(reason=FIRST, samples=samples)])
        self._write_plan()
        return [sample for wave in self._waves() for sample in wave.samples]

    def next(self, left_usd: float) -> list[Sample]:
        """The samples of the next wave, for at most `left_usd` all together; none when sampling has ended."""
        before = self.ledger.sampling
        assert before is not None
        if before.stop_reason is not None and not should_resume(self.application, before):
            return []
        if len(before.batches) >= HOPELESS and not any(one.state == "ok" for one in self.ledger.samples.values()):
            return []
        asked = self._asked(left_usd)
        offers = self.admissible.offers
        taken = {*self.ledger.samples, *(sample.id for wave in self._waves() for sample in wave.samples)}
        samples = [next_on(offers.machine(row), why, taken) for row, why in zip(asked.rows, asked.reasons, strict=True)]
        waves = [*self._waves(), *([Batch(reason=asked.reason, samples=samples)] if samples else [])]
        out_of_budget = not samples and math.isfinite(left_usd) and bool(self._asked(math.inf).rows)
        self._decide(waves, None if samples else asked.reason, out_of_budget)
        self._write_plan()
        return samples

    def _asked(self, left_usd: float) -> NextBatch:
        offers = self.admissible.offers
        return next_samples(
            self.application, offers, list(self.ledger.samples.values()),
            usd_per_sample=offers.price_usd_per_hour * self.lifetime_s / 3600, left_usd=left_usd, library=self.library,
            wave=self.application.spec.benchmark.batch_size,
        )  # fmt: skip

    def _waves(self) -> Sequence[Batch]:
        return self.ledger.sampling.batches if self.ledger.sampling is not None else ()

    def _decide(self, waves: Sequence[Batch], ended: str | None = None, out_of_budget: bool = False) -> None:
        spec = self.application.spec
        self.ledger.decide(Sampling(
            hardware=spec.hardware, infra=spec.infra, limits_digest=limits_of(self.application), batches=list(waves),
            stop_reason=ended,
            out_of_budget=out_of_budget,
        ))  # fmt: skip

    def _write_plan(self) -> None:
        """The plan as compile writes it from the results."""
        assert self.ledger.sampling is not None
        layout, source = self.layout, self.layout.relative(self.layout.spec)
        pins = pins_of_measurement(self.application, read_pins(layout))
        bare = plan_from_campaign(self.application, source, self.catalog, self.ledger.sampling, pins)
        files: dict[Any, bytes] = {}
        exact = pinned(self.application, read_pins(layout))
        plan = with_tasks(exact, with_substitutes(exact, bare, self.admissible), layout, files)
        files[layout.plan] = plan_file(plan, layout)
        self.tasks.adopt(plan, files)
        self.ledger.order[:] = [sample.id for sample in plan.spec.samples]
        self.ledger.plan = digest.of_bytes(files[layout.plan])
        self.ledger.write()


def should_resume(application: Application, sampling: Sampling) -> bool:
    """Whether a campaign that ended is to go on: for other limits, a larger box, or if there is more money now."""
    same = sampling.limits_digest == limits_of(application) and covers(application, sampling)
    return sampling.out_of_budget or not same


def limits_of(application: Application) -> str:
    """A short digest of what machines are asked for: the limits and the objective."""
    chosen = fingerprints.chosen_part(application)
    return digest.shorten(digest.of_value({name: chosen[name] for name in ("constraints", "objective", "metrics")}))
