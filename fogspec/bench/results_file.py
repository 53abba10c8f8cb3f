"""The results file while a benchmark runs: rewritten with its checksum after every sample."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.bench.record import compress, timings_reference
from fogspec.plan.schema import PlanMetadata, Sampling
from fogspec.results.schema import Carried, Measured, Results, ResultsBody, is_final, with_checksum


@dataclass(slots=True, kw_only=True)
class ResultsFile:
    """A `fogspec.bench.types.ResultsSink` on disk.

    `sample_ids` are those of the plan, in its order; `redact` removes the values of secrets from a machine's text. `carried`
    are the changes after which older samples count on, `renewed` the ids of samples that were measured after the last one.
    """

    layout: Layout
    application: str
    plan: str
    runner: str
    source: str | None
    budget_usd: float | None
    sample_ids: list[str]
    redact: Callable[[str], str] = lambda text: text
    pins: dict[str, str] | None = None
    field_digests: dict[str, str] | None = None
    measured: dict[str, Any] | None = None
    carried: list[Carried] = field(default_factory=list)
    sampling: Sampling | None = None
    samples: dict[str, Measured] = field(default_factory=dict)
    spent_usd: float = 0.0
    renewed: set[str] = field(default_factory=set)

    def resume(self, results: Results) -> None:
        """Continue existing results."""
        self.samples = {record.id: record for record in results.spec.samples}
        self.spent_usd = results.spec.spent
        self.sampling = results.spec.sampling

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Write the raw timings next to the results, compressed, and return the record with a reference to them."""
        if record.detail is not None:
            record = record.model_copy(update={"detail": self.redact(record.detail)})
        if timings is None or timings.is_symlink() or not timings.is_file() or not timings.stat().st_size:
            return record
        if self._preferred(record) is not record:
            return record
        content = compress(timings, self.redact)
        path = self.layout.timings / f"{record.id}.jsonl.gz"
        self.layout.files.write(path, content)
        relative = path.relative_to(self.layout.results.parent).as_posix()
        return record.model_copy(update={"timings": timings_reference(relative, content)})

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the file with this record, unless an older one says more: a measurement, or a final failure."""
        if self._preferred(record) is record:
            self.samples[record.id] = record
            self.renewed.add(record.id)
        self.spent_usd = spent_usd
        self.write()

    def paid(self, spent_usd: float) -> None:
        """Write the cost of all samples after a machine was paid for that left no record."""
        if spent_usd != self.spent_usd:
            self.spent_usd = spent_usd
            self.write()

    def decide(self, sampling: Sampling) -> None:
        """Write the decisions of an adaptive campaign."""
        self.sampling = sampling
        self.write()

    def _preferred(self, record: Measured) -> Measured:
        """Keep a measurement over a newer failure, and a final record over one that is not: it has been paid for."""
        older = self.samples.get(record.id)
        if older is None or (older.state == "ok") < (record.state == "ok"):
            return record
        keeps = (older.state == "ok" and record.state != "ok") or (is_final(older) and not is_final(record))
        return older if keeps else record

    def results(self) -> Results:
        """Return the file's content with its checksum: the plan's samples in the plan's order, then others."""
        place = {name: number for number, name in enumerate(self.sample_ids)}
        ordered = sorted(
            self.samples.values(),
            key=lambda r: (*_place(r, place, self.samples), r.id),
        )
        body = ResultsBody(
            application=self.application,
            plan=self.plan,
            pins=self.pins,
            field_digests=self.field_digests,
            measured=self.measured,
            carried=self._carried() or None,
            runner=self.runner,
            source=self.source,
            budget=self.budget_usd,
            spent=self.spent_usd,
            sampling=self.sampling,
            samples=ordered,
        )
        return with_checksum(PlanMetadata(name=self.layout.name), body)

    def _carried(self) -> list[Carried]:
        """Return what samples of older inputs count on for, without those that were measured again."""
        older = {name for name in self.samples if name not in self.renewed}
        steps = (
            one.model_copy(update={"samples": [name for name in one.samples if name in older]}) for one in self.carried
        )
        return [one for one in steps if one.samples]

    def write(self) -> None:
        """Write the file whole, or leave the old one."""
        recorded = " --from RESULTS.yaml" if self.runner == "replay" else ""
        made = (
            shell_command("fogspec", "bench", self.layout.relative(self.layout.spec), "--runner", self.runner)
            + recorded
        )
        self.layout.files.write_yaml(
            self.layout.results, self.results().model_dump(mode="json", exclude_none=True), made
        )


def _place(record: Measured, place: Mapping[str, int], known: Mapping[str, Measured]) -> tuple[int, bool, bool, float]:
    """Return the place of a record: a substitute's is after what it replaces, a part's after its machine, largest first."""
    nested = record.nested_in
    own = record if nested is None else known.get(nested.sample, record)
    at = place.get(own.substitute_for or own.id, len(place))
    return at, own.substitute_for is not None, nested is not None, -record.machine.cpus if nested is not None else 0.0


def set_aside(layout: Layout) -> Path:
    """Move results that measured something else, with their raw timings, to another folder: they were paid for."""
    number, beside, files = 1, layout.results.parent, layout.files
    while files.exists(folder := beside / f"{layout.name}.old-{number}"):
        number += 1
    if files.is_folder(layout.timings):
        files.move(layout.timings, folder / layout.timings.relative_to(beside))
    files.move(layout.results, folder / layout.results.name)
    return folder / layout.results.name
