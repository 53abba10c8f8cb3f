"""Driving a runner: every sample to a record, within the budget, leaving nothing behind.

The loop never blocks: it starts what fits, looks at what runs, ends what is over. Before a machine can cost
anything its start is in the journal; after it is verified gone its record is. So a controller may be killed
between any two steps, and the next one goes on from the journal.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from fogspec.base.outcomes import Refused
from fogspec.effects import collecting
from fogspec.effects.attempt import Attempt
from fogspec.effects.clock import Clock
from fogspec.effects.journal import Journal, Started
from fogspec.effects.orders import Event, Ledger, Order
from fogspec.plan import Sample
from fogspec.results import Measured
from fogspec.seams import CannotStart, Job, LostContact, Progress, Runner

TRIES = 3
BACKOFF_S = (5.0, 30.0)


@dataclass(slots=True)
class Campaign:
    """One run of the loop over one results file; `left` names machines that could not be verified gone."""

    order: Order
    runner: Runner
    journal: Journal
    ledger: Ledger
    clock: Clock
    tell: Callable[[Event], None] = lambda _event: None
    stopping: Callable[[], bool] = lambda: False
    running: dict[str, Attempt] = field(default_factory=dict)
    tries: dict[str, int] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)

    def recover(self) -> set[str]:
        """Finish what an earlier controller left: unwritten records, and machines that may still run.

        Returns the ids of the samples that are running on. Raises Refused when another runner started them.
        """
        for started, record in list(self.journal.book.unwritten.values()):
            if started.application == self.order.application:
                self._write(started.name, record)
            else:
                self.journal.written(started.name)
        for started in list(self.journal.book.open.values()):
            if started.runner != self.runner.name:
                again = f"fogspec bench --runner {started.runner}"
                raise Refused(f"a bench with --runner {started.runner} was interrupted", f"let it finish: {again}")
            self.running[started.name] = self._adopted(started)
        return {a.started.sample.id for a in self.running.values() if a.ending is None}

    def run(self, samples: Sequence[Sample]) -> None:
        """Measure the samples, beside those that run on from before, until nothing is left to do."""
        waiting = [(0.0, sample) for sample in samples]
        try:
            while waiting or self.running:
                if self.stopping():
                    waiting.clear()
                self._start(waiting)
                for attempt in list(self.running.values()):
                    self._advance(attempt, waiting)
                if waiting or self.running:
                    self.clock.sleep(self.runner.poll_s)
        except KeyboardInterrupt:
            self.left += self.running
            raise
        except BaseException:
            self._end_all()
            raise

    def _price(self, sample: Sample) -> float:
        return 0.0 if self.runner.costs == "nothing" else sample.machine.price

    def _adopted(self, started: Started) -> Attempt:
        same_boot = started.boot == self.clock.boot()
        attempt = Attempt(
            started, self._job(started.name, started.sample, started.lifetime_s),
            since_s=started.at_s if same_boot else self.clock.now_s(), same_boot=same_boot,
        )  # fmt: skip
        task = self.order.tasks.get(started.sample.id)
        if started.application != self.order.application or task is None:
            # What it measures is no longer asked for: it is taken down, and paid.
            attempt.ending = Progress(running=False, lost=True)
        return attempt

    def _job(self, name: str, sample: Sample, lifetime_s: float) -> Job:
        task = self.order.tasks.get(sample.id, {})
        return Job(name, sample, task, self.order.root, self.order.attempts / name, lifetime_s)

    def _start(self, waiting: list[tuple[float, Sample]]) -> None:
        now = self.clock.now_s()
        for entry in list(waiting):
            not_before, sample = entry
            if not_before > now or len(self.running) >= self.runner.at_once:
                continue
            commitment = self._price(sample) * self.order.lifetime_s / 3600
            book, budget = self.journal.book, self.order.budget_usd
            if budget is not None and book.spent_usd + book.committed_usd + commitment > budget * (1 + 1e-12):
                if not self.running:
                    waiting.remove(entry)
                    self._unaffordable(sample, commitment)
                continue
            waiting.remove(entry)
            self._launch(sample, now)

    def _launch(self, sample: Sample, now: float) -> None:
        number = self.journal.book.attempts + 1
        name = f"fogspec-{sample.id[:40]}-{self.order.token}-{number}"
        started = Started(
            name, self.runner.name, self.order.application, sample, self._price(sample),
            self.order.lifetime_s, now, self.clock.boot(),
        )  # fmt: skip
        self.journal.start(started)
        attempt = Attempt(started, self._job(name, sample, started.lifetime_s), now, same_boot=True)
        self.running[name] = attempt
        self.tries[sample.id] = self.tries.get(sample.id, 0) + 1
        self._say(sample, "starts")
        try:
            self.runner.start(attempt.job)
        except CannotStart as no:
            attempt.ending = Progress(running=False, reason=no.reason, detail=no.detail, billed_s=0.0)
            attempt.again = no.again
        except LostContact as lost:
            self._say(sample, "lost contact", detail=str(lost))

    def _advance(self, attempt: Attempt, waiting: list[tuple[float, Sample]]) -> None:
        if attempt.ending is None:
            attempt.ending = self._look(attempt)
        if attempt.ending is not None and self.clock.now_s() >= attempt.end_after_s and self._ended(attempt):
            self._finish(attempt, attempt.ending, waiting)

    def _look(self, attempt: Attempt) -> Progress | None:
        """How the sample ended, or None while it runs."""
        sample, now = attempt.started.sample, self.clock.now_s()
        try:
            progress = self.runner.look(attempt.job)
        except LostContact as lost:
            self._say(sample, "lost contact", detail=str(lost))
            attempt.unheard(now)
        else:
            attempt.heard(progress)
            if not progress.running:
                return progress
            self._say(sample, "measures" if progress.ready else "sets up", progress=progress)
        if self.stopping():
            return attempt.interrupted()
        return attempt.overdue(self.clock.now_s(), self.order.deadline_s)

    def _ended(self, attempt: Attempt) -> bool:
        try:
            self.runner.end(attempt.job)
        except LostContact as lost:
            self._say(attempt.started.sample, "cannot be ended yet", detail=str(lost))
            if attempt.not_ended(self.clock.now_s()):
                # It stays open in the journal: the next bench asks again, and its bill stays committed.
                self.left.append(attempt.started.name)
                del self.running[attempt.started.name]
            return False
        return True

    def _finish(self, attempt: Attempt, end: Progress, waiting: list[tuple[float, Sample]]) -> None:
        started, sample = attempt.started, attempt.started.sample
        billed_s = attempt.billed_s(end, self.clock.now_s())
        # What was recorded was paid then, at that time's prices and rounding.
        recorded = end.recorded
        spent_usd = started.price_usd_per_hour * billed_s / 3600 if recorded is None else recorded.spent
        wanted = started.application == self.order.application and sample.id in self.order.tasks
        tries = self.tries.get(sample.id, 1)
        if not wanted or ((attempt.again or end.lost) and tries < TRIES and not self.stopping()):
            self.journal.end(started.name, spent_usd, None)
            if wanted:
                pause = BACKOFF_S[min(tries, len(BACKOFF_S)) - 1]
                waiting.append((self.clock.now_s() + pause, sample))
                self.tries[sample.id] = tries
            self._say(sample, "is tried again" if wanted else "is no longer wanted", detail=end.detail)
        else:
            if end.lost:
                end = replace(end, reason="interrupted", detail=end.detail or "its results are beyond reach")
            record = collecting.measured(sample, end, self.order.rules, billed_s, spent_usd)
            record = self.ledger.keep(record, end.timings)
            self.journal.end(started.name, spent_usd, record)
            self._write(started.name, record)
        del self.running[started.name]

    def _write(self, name: str, record: Measured) -> None:
        self.ledger.put(record, self.journal.book.spent_usd)
        self.journal.written(name)
        sample = Sample(id=record.id, machine=record.machine, reason="")
        self._say(sample, "is done", record=record)

    def _unaffordable(self, sample: Sample, commitment: float) -> None:
        left = (self.order.budget_usd or 0.0) - self.journal.book.spent_usd
        detail = f"would commit ${commitment:.4f}, and ${max(left, 0.0):.4f} of the budget is left"
        progress = Progress(running=False, reason="budget", detail=detail)
        record = collecting.measured(sample, progress, self.order.rules, 0.0, 0.0)
        self.ledger.put(record, self.journal.book.spent_usd)
        self._say(sample, "is done", record=record)

    def _end_all(self) -> None:
        for name, attempt in list(self.running.items()):
            try:
                self.runner.end(attempt.job)
            except Exception as problem:
                self.left.append(name)
                self._say(attempt.started.sample, "cannot be ended", detail=str(problem))

    def _say(
        self,
        sample: Sample,
        what: str,
        progress: Progress | None = None,
        record: Measured | None = None,
        detail: str | None = None,
    ) -> None:
        book = self.journal.book
        self.tell(Event(sample, what, book.spent_usd, book.committed_usd, progress, record, detail))
