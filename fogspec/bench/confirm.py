"""Confirm older results after a change: the chosen machine, measured once more, must take as long as they say.

The test: the new latency lies in the interval that the older results give for another server of the machine's type, which
9 of 10 unchanged applications pass. It says nothing of a change that is small against the width of the interval, nor of one
that shows only on other machines; so the provenance of what is carried on has the interval and what can be detected.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogspec.base.errors import Refused, UsageError
from fogspec.base.text import shell_command
from fogspec.base.units import rounded, shown_duration
from fogspec.bench.prepare import Prepared, read_task
from fogspec.bench.record import timings_reference
from fogspec.bench.results_file import ResultsFile, set_aside
from fogspec.catalog.filters import filter_offers
from fogspec.catalog.machine import Machine
from fogspec.choice.menu import LEVEL
from fogspec.compile.decision import Selection, select
from fogspec.compile.inputs import Inputs
from fogspec.compile.plan_files import task_file
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.plan.schema import next_on, sample_on
from fogspec.results.schema import Carried, Confirmation, LatencySummary, Measured, Results, own_records, with_checksum
from fogspec.results.standing import Standing
from fogspec.spec.fingerprints import waivable
from fogspec.spec.lockfile import pinned
from fogspec.spec.schema import Statistic

Interval = tuple[float, float]
QUANTILE = 1.645  # of a normal variable: 90% lie within it on both sides
POWER_QUANTILE = 0.842  # 80% lie below it


@dataclass(frozen=True, slots=True, kw_only=True)
class Expected:
    """What the older results expect of the chosen machine after a harmless change: intervals of its latency and metrics."""

    machine: Machine
    statistic: Statistic
    latency_s: Interval
    metrics: Mapping[str, Interval] = field(default_factory=dict)
    changes: tuple[str, ...] = ()

    @property
    def detectable(self) -> float:
        """The relative change of the latency that the test finds in 4 of 5 cases; smaller ones it finds less often."""
        low, high = self.latency_s
        half = math.log(high / low) / 2
        return math.expm1(half * (1 + POWER_QUANTILE / QUANTILE))

    @property
    def line(self) -> str:
        """Return the test, for people."""
        low, high = map(shown_duration, self.latency_s)
        return (
            f"the results count on if its {self.statistic} latency is in [{low}, {high}], where those of {LEVEL:.0%} of "
            f"unchanged ones are; a change by less than {self.detectable:.0%} can pass, as can one on other machines only"
        )

    def confirmation(self, record: Measured) -> Confirmation | None:
        """Return the confirmation by a new measurement; None if it is not what the older results expect."""
        measured = None if record.latency is None else _statistic(record.latency, self.statistic)
        if measured is None or not self.latency_s[0] <= measured <= self.latency_s[1]:
            return None
        for name, (low, high) in self.metrics.items():
            if name not in record.metrics or not low <= record.metrics[name] <= high:
                return None
        return Confirmation(
            sample=record.id,
            changes=list(self.changes),
            statistic=self.statistic,
            latency=measured,
            interval=self.latency_s,
            level=LEVEL,
            detectable=rounded(self.detectable),
            metrics={name: record.metrics[name] for name in self.metrics},
        )


def confirming(prepared: Prepared, inputs: Inputs) -> tuple[Prepared, Expected]:
    """Return what measures the chosen machine alone, and what the older results on disk expect of it.

    Raise UsageError if there is nothing to confirm, Refused if the older results choose no machine, or give no interval for
    it.
    """
    name, older = prepared.layout.name, prepared.read
    if older is None or not prepared.outdated:
        raise UsageError(
            f"{name}: there is nothing to confirm: {'nothing is measured' if older is None else 'the results count'}",
            shell_command("fogspec", "status", prepared.layout.spec),
        )
    if not _comparable(prepared.standing):
        raise Refused(
            f"{name}: {', '.join(prepared.standing.fields)} changed: older figures mean something else",
            f"measure again: {shell_command('fogspec', 'bench', prepared.layout.spec)}",
        )
    application = pinned(prepared.application, inputs.pins)
    admissible = filter_offers(inputs.catalog, application.spec.hardware, application.spec.infra)
    found = select(inputs, application, admissible, older)
    expected = _expected(prepared, older, found)
    if expected is None:
        raise Refused(
            f"{name}: the older results choose no machine that could be compared",
            f"measure again: {shell_command('fogspec', 'bench', prepared.layout.spec)}",
        )
    sample = sample_on(expected.machine, "to confirm the results from before a change")
    sample = next((one for one in prepared.plan.spec.samples if one.id == sample.id), sample)
    sample = sample.model_copy(update={"parts": []})
    tasks = dict(prepared.tasks)
    if sample.id not in tasks:
        tasks[sample.id] = read_task(task_file(application, prepared.plan, sample, prepared.layout))
    return replace(prepared, todo=(sample,), tasks=tasks, results=None, outdated=False, only=True), expected


def _comparable(found: Standing) -> bool:
    """Return whether no field changed that defines the figures."""
    return all(waivable(name) for name in found.fields if name != "spec")


def _expected(prepared: Prepared, older: Results, found: Selection) -> Expected | None:
    statistic = prepared.application.spec.constraints.statistic
    changes = tuple(prepared.standing.reasons)
    choice = found.choice
    if found.models.spec.measured_on_local:
        measured = [one for one in own_records(older.spec.samples) if one.state == "ok" and one.latency is not None]
        known = [(one.machine, at_s) for one in measured if (at_s := _statistic(one.latency, statistic)) is not None]
        if not known:
            return None
        machine, latency_s = max(known, key=lambda one: one[0].cpus)
        # Two samples of one host: each errs by as much as a sample without a known error.
        spread = math.exp(QUANTILE * math.sqrt(2) * DEFAULT_NOISE)
        ends = (latency_s / spread, latency_s * spread)
        return Expected(machine=machine, statistic=statistic, latency_s=ends, changes=changes)
    row = choice.chosen
    interval = None if row is None else choice.latency.interval(row, LEVEL)
    if row is None or interval is None:
        return None
    metrics = {name: at for name, one in choice.metrics.items() if (at := one.interval(row, LEVEL)) is not None}
    return Expected(
        machine=choice.offers.machine(row), statistic=statistic, latency_s=interval, metrics=metrics, changes=changes
    )


def _statistic(latency: LatencySummary | None, statistic: Statistic) -> float | None:
    value: float | None = None if latency is None else getattr(latency, statistic)
    return value


@dataclass(slots=True, kw_only=True)
class ConfirmingFile(ResultsFile):
    """The results file while older results are confirmed: it stays as it is until the new measurement is there.

    Then the older samples and the new one count; or the older results are moved to another folder, and the new one counts.
    """

    older: Results
    expected: Expected
    confirmed: Confirmation | None = None
    decided: bool = False
    aside: Path | None = None

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Write the raw timings beside those of the older samples, none of which they replace."""
        own = self._renamed(record)
        return ResultsFile.keep(self, own, timings).model_copy(update={"id": record.id})

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the older results with this record, or this record alone; a failure says nothing of the older results."""
        self.spent_usd = spent_usd
        if record.state != "ok":
            self.paid(spent_usd)
            return
        own = self._renamed(record)
        self.confirmed, self.decided = self.expected.confirmation(own), True
        if self.confirmed is not None:
            body = self.older.spec
            names = [one.id for one in body.samples]
            before = Carried(application=body.application, pins=body.pins, samples=names, confirmed=self.confirmed)
            self.samples = {one.id: one for one in body.samples} | {own.id: own}
            self.sampling, self.renewed = body.sampling, {own.id}
            self.carried = [*(body.carried or ()), before]
        else:
            alone = self._moved(own, record.id)
            self.samples, self.renewed = {record.id: alone}, {record.id}
        self.write()

    def paid(self, spent_usd: float) -> None:
        """Write the cost into the older results; they stay as they are."""
        self.spent_usd = spent_usd
        if not self.decided:
            self.write()

    def results(self) -> Results:
        """Return the file's content: the older results with what was paid, until the measurement decides."""
        if self.decided:
            return ResultsFile.results(self)
        return with_checksum(self.older.metadata, self.older.spec.model_copy(update={"spent": self.spent_usd}))

    def _renamed(self, record: Measured) -> Measured:
        """Return the record as a further sample of its machine, beside the older ones."""
        taken = {one.id for one in self.older.spec.samples}
        if record.id not in taken:
            return record
        return record.model_copy(update={"id": next_on(record.machine, "", taken).id})

    def _moved(self, record: Measured, name: str) -> Measured:
        """Set the older results aside; return the record under its own name again, with its raw timings."""
        timings, files = record.timings, self.layout.files
        written = None if timings is None else self.layout.results.parent / timings.path
        content = None if written is None else files.read(written)
        if written is not None:
            files.remove(written)
        self.aside = set_aside(self.layout)
        record = record.model_copy(update={"id": name})
        if content is None:
            return record
        path = self.layout.timings / f"{name}.jsonl.gz"
        files.write(path, content)
        relative = path.relative_to(self.layout.results.parent).as_posix()
        return record.model_copy(update={"timings": timings_reference(relative, content)})
