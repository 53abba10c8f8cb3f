"""The files of results while a benchmark runs: that of a sample is written with its checksum when it has ended."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogspec.agent.packages import MOST_BYTES
from fogspec.base import digest
from fogspec.base.files import open_untrusted
from fogspec.base.layout import Layout
from fogspec.bench.record import compress
from fogspec.bench.types import measuring
from fogspec.plan.schema import Sample, Sampling
from fogspec.results.folded import folded, split
from fogspec.results.io import ASIDE, timings_path, write_results
from fogspec.results.packages import checked
from fogspec.results.schema import (
    Carried,
    Measured,
    ResultBody,
    Results,
    ResultsBody,
    is_final,
    results_of,
)

ROUNDED_USD = 1e-6


@dataclass(slots=True, kw_only=True)
class ResultsFile:
    """A `fogspec.bench.types.ResultsSink` on disk.

    `carried` are the changes after which older samples count on, `renewed` the ids of samples that were measured after the
    last one. `paid_usd` is what each sample has cost, and `before_usd` what results cost that were set aside: together they
    are never less than what the campaign has spent.
    """

    layout: Layout
    inputs: dict[str, Any]
    runner: str
    source: str | None
    carried: list[Carried] = field(default_factory=list)
    sampling: Sampling | None = None
    samples: dict[str, Measured] = field(default_factory=dict)
    paid_usd: dict[str, float] = field(default_factory=dict)
    before_usd: float = 0.0
    renewed: set[str] = field(default_factory=set)
    _written: dict[str, ResultBody] = field(default_factory=dict)

    def resume(self, results: Results) -> None:
        """Continue existing results."""
        self.samples = {record.id: record for record in results.spec.samples}
        self.sampling = results.spec.sampling
        self.begin(results)

    def begin(self, results: Results) -> None:
        """Begin with what is on disk, and what it cost."""
        self.paid_usd, self.before_usd = results.spec.costs, results.spec.before
        self._written = {one.id: one for one in split(results.spec)}

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Write raw timings, compressed, and packages next to the results; return the record with their digests."""
        if timings is None or timings.is_symlink() or not timings.is_file() or not timings.stat().st_size:
            return record
        if self._preferred(record) is not record:
            return record
        record = self._keep_packages(record, timings.parent / "packages.txt")
        content = compress(timings)
        self.layout.files.write(timings_path(self.layout.results, record.id), content)
        return record.model_copy(update={"timings": digest.of_bytes(content)})

    def _keep_packages(self, record: Measured, path: Path) -> Measured:
        """Write the machine's list of packages, once per distinct list, and return the record with its digest."""
        if record.server is None or path.is_symlink() or not path.is_file():
            return record
        with open_untrusted(path) as file:
            text = checked(file.read(MOST_BYTES + 1))
        if text is None:
            return record
        named = digest.of_bytes(text.encode())
        self.layout.files.write(self.layout.packages(named), text.encode())
        return record.model_copy(update={"server": record.server.model_copy(update={"packages": named})})

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the file of this record, unless an older one says more: a measurement, or a final failure."""
        if self._preferred(record) is record:
            self.samples[record.id] = record
            self.renewed.add(record.id)
        self._pay(record.id, spent_usd, record.spent)
        self.write()

    def unheard(self, only: bool) -> bool:
        """Return whether samples, with `only` those of this bench, lack what the spec expects, and none was measured."""
        found = [one for one in self.samples.values() if not only or one.id in self.renewed]
        certain = any(one.reason == "not_reported" and (one.spent or one.id in self.renewed) for one in found)
        return certain and not any(one.state == "ok" for one in found)

    def paid(self, sample: Sample, spent_usd: float) -> None:
        """Write the cost of a machine that left no record into the file of its sample."""
        if self._pay(sample.id, spent_usd):
            self.write()

    def _pay(self, sample: str, spent_usd: float, expected_usd: float = 0.0) -> bool:
        """Add to what a sample cost what the campaign has spent and no file has yet; return whether that is anything."""
        missing_usd = spent_usd - self.before_usd - math.fsum(self.paid_usd.values())
        # The sum is rounded, the cost of a record is not.
        added_usd = expected_usd if abs(missing_usd - expected_usd) < ROUNDED_USD else max(missing_usd, 0.0)
        before_usd = self.paid_usd.setdefault(sample, 0.0)
        self.paid_usd[sample] = before_usd + added_usd if before_usd else added_usd
        return added_usd > 0

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
        """Return what the files say together."""
        found = folded(list(split(self._body())), self.before_usd)
        return results_of(self._body()) if found is None else found

    def _body(self) -> ResultsBody:
        return ResultsBody(
            inputs=self.inputs,
            carried=self._carried() or None,
            runner=self.runner,
            source=self.source,
            sampling=self.sampling,
            samples=list(self.samples.values()),
            paid=self.paid_usd,
            before=self.before_usd,
        )

    def _carried(self) -> list[Carried]:
        """Return what samples of older inputs count on for, without those that were measured again."""
        older = {name for name in self.samples if name not in self.renewed}
        steps = (
            one.model_copy(update={"samples": [name for name in one.samples if name in older]}) for one in self.carried
        )
        return [one for one in steps if one.samples]

    def write(self) -> None:
        """Write the files that changed, each whole, or leave the old one."""
        write_results(
            self.layout.results, self.results().spec, measuring(self.runner), self.layout.files, self._written
        )


def set_aside(layout: Layout) -> Path:
    """Move results that measured something else, with their raw timings, to another folder: they were paid for."""
    number, beside, files = 1, layout.results.parent, layout.files
    while files.exists(folder := beside / f"{layout.name}{ASIDE}{number}"):
        number += 1
    files.move(layout.results, folder)
    return folder
