"""Confirm older results after a change: the chosen machine, measured once more, must take as long as they say.

The test: the new latency lies in the interval that the older results give for another server of the machine's type, which
9 of 10 unchanged applications pass. It says nothing of a change that is small against the width of the interval, nor of one
that shows only on other machines; so the provenance of what is carried on has the interval and what can be detected.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogspec.base import digest
from fogspec.base.layout import MOST_BYTES
from fogspec.base.units import rounded, shown_duration
from fogspec.bench.prepare import Prepared, against_spec
from fogspec.bench.results_file import ResultsFile, set_aside
from fogspec.catalog.filters import offers_for
from fogspec.catalog.machine import Machine
from fogspec.choice.menu import LEVEL
from fogspec.compile.decision import Selection, select
from fogspec.compile.inputs import Inputs
from fogspec.language.fingerprints import change_text
from fogspec.language.lockfile import pinned
from fogspec.language.schema import Statistic
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.plan.schema import Sample, is_apart, next_on, sample_on
from fogspec.results.io import timings_path
from fogspec.results.schema import Carried, Confirmation, LatencySummary, Measured, Results, results_of
from fogspec.results.standing import input_changes

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


def confirming(prepared: Prepared, inputs: Inputs, runner: str) -> tuple[Prepared, Expected | None]:
    """Return what measures the chosen machine alone, and what the older results on disk expect of it.

    The same samples as before and None if there is nothing to confirm, if the older figures mean something else or are of
    another runner, or if they choose no machine, or give no interval for it.
    """
    older = prepared.read
    if older is None or not prepared.outdated or not prepared.standing.comparable or older.spec.runner != runner:
        return prepared, None
    application = pinned(prepared.application, inputs.pins)
    admissible = offers_for(inputs.catalog, application.spec)
    found = select(inputs, application, admissible, older)
    expected = _expected(prepared, older, found)
    if expected is None:
        return prepared, None
    machine, samples = expected.machine, prepared.plan.spec.samples
    known = {one.id: one.machine for one in samples}
    sample = sample_on(machine, "to confirm the results from before a change", apart=is_apart(machine, known))
    sample = next((one for one in samples if one.machine.identity == machine.identity), sample)
    return replace(prepared.measuring(sample, inputs), results=None, outdated=False), expected


def _expected(prepared: Prepared, older: Results, found: Selection) -> Expected | None:
    statistic = prepared.application.spec.constraints.statistic
    changes = tuple(map(change_text, input_changes(older.spec.inputs, prepared.plan.spec.inputs)))
    choice = found.choice
    if found.models.measured_on_local:
        measured = [one for one in older.spec.samples if one.state == "ok" and one.latency is not None]
        measured = [one for one in measured if against_spec(prepared.application, one.machine) is None]
        known = [(one.machine, at_s) for one in measured if (at_s := _statistic(one.latency, statistic)) is not None]
        if not known:
            return None
        machine, latency_s = max(known, key=lambda one: one[0].cpus)
        # Two samples of one host: each errs by as much as a sample without a known error.
        spread = math.exp(QUANTILE * math.sqrt(2) * DEFAULT_NOISE)
        ends = (latency_s / spread, latency_s * spread)
        return Expected(machine=machine, statistic=statistic, latency_s=ends, changes=changes)
    row = choice.chosen
    interval = None if row is None else choice.latency.alone.interval(row, LEVEL)
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
    """The results while older ones are confirmed: these stay as they are until the new measurement is there.

    Then the older samples and the new one count; or the older results are moved to another folder, and the new one counts.
    A sample that `failed` is in no file.
    """

    older: Results
    expected: Expected
    confirmed: Confirmation | None = None
    decided: bool = False
    failed: Measured | None = None

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        """Write the raw timings beside those of the older samples, none of which they replace."""
        own = self._renamed(record)
        return ResultsFile.keep(self, own, timings).model_copy(update={"id": record.id})

    def put(self, record: Measured, spent_usd: float) -> None:
        """Write the older results with this record, or this record alone; a failure says nothing of the older results."""
        self.failed = None if record.state == "ok" else record
        if self.failed is not None:
            self._pay(record.id, spent_usd, record.spent)
            self._write_older()
            return
        own = self._renamed(record)
        self.confirmed, self.decided = self.expected.confirmation(own), True
        if self.confirmed is not None:
            body = self.older.spec
            names = [one.id for one in body.samples]
            before = Carried(inputs=digest.of_value(body.inputs), samples=names, confirmed=self.confirmed)
            self.samples = {one.id: one for one in body.samples} | {own.id: own}
            self.sampling, self.renewed = body.sampling, {own.id}
            self.carried = [*(body.carried or ()), before]
            self._pay(own.id, spent_usd, own.spent)
        else:
            alone = self._moved(own, record.id)
            self.samples, self.renewed = {record.id: alone}, {record.id}
            self.before_usd, self.paid_usd, self._written = sum((self.before_usd, *self.paid_usd.values())), {}, {}
            self._pay(record.id, spent_usd, record.spent)
        self.write()

    def paid(self, sample: Sample, spent_usd: float) -> None:
        """Write the cost into the older results; they stay as they are."""
        if self._pay(sample.id, spent_usd):
            self._write_older()

    def _write_older(self) -> None:
        if not self.decided:
            self.write()

    def results(self) -> Results:
        """Return what the files say: the older results with what was paid, until the measurement decides."""
        if self.decided:
            return ResultsFile.results(self)
        return results_of(self.older.spec.model_copy(update={"paid": self.paid_usd}))

    def _renamed(self, record: Measured) -> Measured:
        """Return the record as a further sample of its machine, beside the older ones."""
        taken = self.older.spec.machines
        if record.id not in taken:
            return record
        return record.model_copy(update={"id": next_on(record.machine, "", taken).id})

    def _moved(self, record: Measured, name: str) -> Measured:
        """Set the older results aside; return the record under its own name again, with its raw timings."""
        written, files = timings_path(self.layout.results, record.id), self.layout.files
        content = None if record.timings is None else files.read(written, MOST_BYTES)
        if content is not None:
            files.remove(written)
        set_aside(self.layout)
        if content is not None:
            files.write(timings_path(self.layout.results, name), content)
        return record.model_copy(update={"id": name})
