"""The results file while a benchmark runs: written anew, whole and sealed, after every finished sample."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.base.files import write_bytes, write_yaml
from fogspec.base.layout import Layout
from fogspec.bench.record import compress, timings_reference
from fogspec.plan.schema import PlanMetadata, Sampling
from fogspec.results.schema import Measured, Results, ResultsBody, is_final, with_checksum


@dataclass(slots=True)
class ResultsFile:
    """A ledger on disk: implements `fogspec.bench.types.Ledger`.

    `order` is the plan's order of sample ids; `redact` takes secrets' values out of what a machine said.
    """

    layout: Layout
    application: str
    plan: str
    runner: str
    source: str | None
    budget_usd: float | None
    order: list[str]
    redact: Callable[[str], str] = lambda text: text
    pins: dict[str, str] | None = None
    field_digests: dict[str, str] | None = None
    sampling: Sampling | None = None
    samples: dict[str, Measured] = field(default_factory=dict)
    spent_usd: float = 0.0

    def take(self, results: Results) -> None:
        """Go on from results that are there already."""
        self.samples = {record.id: record for record in results.spec.samples}
        self.spent_usd = results.spec.spent
        self.sampling = results.spec.sampling

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Write the raw timings beside the results, compressed, and name them in the record."""
        if record.detail is not None:
            record = record.model_copy(update={"detail": self.redact(record.detail)})
        if timings is None or timings.is_symlink() or not timings.is_file() or not timings.stat().st_size:
            return record
        if self._better(record) is not record:
            return record
        content = compress(timings, self.redact)
        path = self.layout.timings / f"{record.id}.jsonl.gz"
        write_bytes(path, content)
        relative = path.relative_to(self.layout.results.parent).as_posix()
        return record.model_copy(update={"timings": timings_reference(relative, content)})

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the file with this record in place of an older one, unless the older one says more."""
        self.samples[record.id] = self._better(record)
        self.spent_usd = spent_usd
        self.write()

    def paid(self, spent_usd: float) -> None:
        """What all of it cost so far, where a machine was paid for and left no record."""
        if spent_usd != self.spent_usd:
            self.spent_usd = spent_usd
            self.write()

    def decide(self, sampling: Sampling) -> None:
        """Write what was decided of an adaptive campaign."""
        self.sampling = sampling
        self.write()

    def _better(self, record: Measured) -> Measured:
        """The older record where there is one that is finished and this one is not: it was paid for."""
        older = self.samples.get(record.id)
        keeps = older is not None and is_final(older) and not is_final(record)
        return older if older is not None and keeps else record

    def results(self) -> Results:
        """What the file says, sealed: the plan's samples in the plan's order, then others."""
        place = {name: number for number, name in enumerate(self.order)}
        ordered = sorted(
            self.samples.values(),
            key=lambda r: (place.get(r.substitute_for or r.id, len(place)), r.substitute_for is not None, r.id),
        )
        body = ResultsBody(
            application=self.application, plan=self.plan, pins=self.pins, field_digests=self.field_digests,
            runner=self.runner, source=self.source,
            budget=self.budget_usd, spent=self.spent_usd, sampling=self.sampling, samples=ordered,
        )  # fmt: skip
        return with_checksum(PlanMetadata(name=self.layout.name), body)

    def write(self) -> None:
        """Write the file: another one appears in its place, or the old one stays."""
        recorded = " --from RESULTS.yaml" if self.runner == "replay" else ""
        made = f"fogspec bench {self.layout.relative(self.layout.spec)} --runner {self.runner}{recorded}"
        write_yaml(self.layout.results, self.results().model_dump(mode="json", exclude_none=True), made)


def set_aside(layout: Layout) -> Path:
    """Keep results that measured something else, with their raw timings, in another folder: they were paid for."""
    number, beside = 1, layout.results.parent
    while (folder := beside / f"{layout.name}.old-{number}").exists():
        number += 1
    timings = folder / layout.timings.relative_to(beside)
    timings.parent.mkdir(parents=True)
    if layout.timings.is_dir():
        os.rename(layout.timings, timings)
    return layout.results.rename(folder / layout.results.name)
