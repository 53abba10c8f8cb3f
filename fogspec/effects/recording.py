"""The results file while a benchmark runs: written anew, whole and sealed, after every finished sample."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.effects import collecting
from fogspec.effects.files import write_bytes, write_yaml
from fogspec.effects.layout import Layout
from fogspec.plan import PlanMetadata
from fogspec.results import Measured, Results, ResultsBody, sealed


@dataclass(slots=True)
class ResultsFile:
    """A ledger on disk: implements `fogspec.effects.orders.Ledger`.

    `order` is the plan's order of sample ids; `redact` takes secrets' values out of what a machine said.
    """

    layout: Layout
    application: str
    plan: str
    runner: str
    source: str | None
    budget_usd: float | None
    order: Sequence[str]
    redact: Callable[[str], str] = lambda text: text
    pins: dict[str, str] | None = None
    reads: dict[str, str] | None = None
    samples: dict[str, Measured] = field(default_factory=dict)
    spent_usd: float = 0.0

    def take(self, results: Results) -> None:
        """Go on from results that are there already."""
        self.samples = {record.id: record for record in results.spec.samples}
        self.spent_usd = results.spec.spent

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Write the raw timings beside the results, compressed, and name them in the record."""
        if record.detail is not None:
            record = record.model_copy(update={"detail": self.redact(record.detail)})
        if timings is None or not timings.is_file() or not timings.stat().st_size:
            return record
        if self._better(record) is not record:
            return record
        content = collecting.packed(timings)
        path = self.layout.timings / f"{record.id}.jsonl.gz"
        write_bytes(path, content)
        relative = path.relative_to(self.layout.results.parent).as_posix()
        return record.model_copy(update={"timings": collecting.reference(relative, content)})

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the file with this record in place of an older one, unless the older one says more."""
        self.samples[record.id] = self._better(record)
        self.spent_usd = spent_usd
        self.write()

    def _better(self, record: Measured) -> Measured:
        """The older record where there is one that is finished and this one is not: it was paid for."""
        older = self.samples.get(record.id)
        keeps = older is not None and collecting.finished(older) and not collecting.finished(record)
        return older if older is not None and keeps else record

    def results(self) -> Results:
        """What the file says, sealed: the plan's samples in the plan's order, then others."""
        place = {name: number for number, name in enumerate(self.order)}
        ordered = sorted(self.samples.values(), key=lambda r: (place.get(r.id, len(place)), r.id))
        body = ResultsBody(
            application=self.application, plan=self.plan, pins=self.pins, reads=self.reads,
            runner=self.runner, source=self.source,
            budget=self.budget_usd, spent=self.spent_usd, samples=ordered,
        )  # fmt: skip
        return sealed(PlanMetadata(name=self.layout.name), body)

    def write(self) -> None:
        """Write the file: another one appears in its place, or the old one stays."""
        recorded = " --from RESULTS.yaml" if self.runner == "replay" else ""
        made = f"fogspec bench {self.layout.relative(self.layout.spec)} --runner {self.runner}{recorded}"
        write_yaml(self.layout.results, self.results().model_dump(mode="json", exclude_none=True), made)
