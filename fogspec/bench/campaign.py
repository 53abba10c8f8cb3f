"""Driving a runner: every sample to a record, within the budget, leaving nothing behind.

The loop never blocks: it starts what fits, looks at what runs, ends what is over. Before a machine can cost
anything its start is in the journal; after it is verified gone its record is. So a controller may be killed
between any two steps, and the next one goes on from the journal.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from fogspec.backends.protocol import Job, LaunchRefused, Progress, Runner, Unreachable
from fogspec.base.clock import Clock
from fogspec.base.errors import Refused
from fogspec.bench.attempt import Attempt
from fogspec.bench.journal import Journal, LaunchRecord
from fogspec.bench.record import make_record, within_attempt
from fogspec.bench.retry import RetryPolicy, overdrawn
from fogspec.bench.types import CampaignConfig, Event, Queued, ResultsSink
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured

IDLE_S = 0.5
SLOW_ENDS = 4


@dataclass(slots=True)
class Campaign:
    """One run of the loop over one results file; `left` names machines that could not be verified gone."""

    order: CampaignConfig
    runner: Runner
    journal: Journal
    ledger: ResultsSink
    clock: Clock
    tell: Callable[[Event], None] = lambda _event: None
    stopping: Callable[[], bool] = lambda: False
    running: dict[str, Attempt] = field(default_factory=dict)
    waiting: list[Queued] = field(default_factory=list)
    tries: RetryPolicy = field(default_factory=RetryPolicy)
    left: list[str] = field(default_factory=list)

    def recover(self) -> set[str]:
        """Finish what an earlier controller left: unwritten records, and machines that may still run.

        Returns the ids of the samples that are running on, or for which another runs on. Raises Refused when another
        runner started them.
        """
        for started, record in list(self.journal.book.unwritten.values()):
            if started.application == self.order.application:
                self._write(started, record)
            else:
                self.journal.written(started.name)
        for started in list(self.journal.book.open.values()):
            if started.runner != self.runner.name:
                again = f"fogspec bench --runner {started.runner}"
                raise Refused(f"a bench with --runner {started.runner} was interrupted", f"let it finish: {again}")
            self.running[started.name] = self._adopted(started)
        going_on = [a.started for a in self.running.values() if a.ending is None]
        return {name for one in going_on for name in (one.sample.id, one.substitute_for) if name is not None}

    def run(self, samples: Sequence[Sample]) -> None:
        """Measure the samples, beside those that run on from before, until nothing is left to do."""
        self.waiting += [Queued(sample) for sample in samples]
        try:
            while self.waiting or self.running:
                if self.stopping():
                    self.waiting.clear()
                self._start_what_fits()
                self._stop_what_does_not_fit()
                for attempt in list(self.running.values()):
                    self._advance(attempt)
                if self.waiting or self.running:
                    self.clock.sleep(self._pause_s())
        except KeyboardInterrupt:  # at once: the journal has what may still run
            raise
        except BaseException:
            self._end_all()
            raise

    def _pause_s(self) -> float:
        """Until something may have changed; a wait for the next try is not spent in looking."""
        if self.running:
            return self.runner.poll_s
        wait_s = min(entry.not_before_s for entry in self.waiting) - self.clock.now_s()
        return max(self.runner.poll_s, min(wait_s, IDLE_S))

    def price(self, sample: Sample) -> float:
        """USD per hour that measuring it costs with this runner."""
        return 0.0 if self.runner.costs == "nothing" else sample.machine.price

    def _adopted(self, started: LaunchRecord) -> Attempt:
        same_boot = started.boot == self.clock.boot()
        task = self.order.task(started.sample) if started.application == self.order.application else None
        attempt = Attempt(
            started, self._job(started, task or {}),
            since_s=started.at_s if same_boot else self.clock.now_s(), same_boot=same_boot,
        )  # fmt: skip
        self.tries.started(started.sample.id)
        if task is None:
            # What it measures is no longer asked for: it is taken down, and paid.
            attempt.ending = Progress(running=False, lost=True)
        return attempt

    def _job(self, started: LaunchRecord, task: object) -> Job:
        assert isinstance(task, dict)
        order = self.order
        return Job(started.name, started.sample, task, order.root, order.attempts / started.name, started.lifetime_s)

    def _start_what_fits(self) -> None:
        now = self.clock.now_s()
        for entry in list(self.waiting):
            if entry.not_before_s > now or len(self.running) >= self.runner.at_once:
                continue
            commitment = self.price(entry.sample) * self.order.lifetime_s / 3600
            book, budget = self.journal.book, self.order.budget_usd
            if budget is not None and overdrawn(book.spent_usd + book.committed_usd + commitment, budget):
                if not self.running:
                    self.waiting.remove(entry)
                    self._unaffordable(entry, commitment)
                continue
            self.waiting.remove(entry)
            self._launch(entry, now)

    def _launch(self, entry: Queued, now: float) -> None:
        sample, order = entry.sample, self.order
        task = order.task(sample)
        assert task is not None, sample.id
        started = LaunchRecord(
            order.name(sample, self.journal.book.attempts + 1), self.runner.name, order.application, sample,
            self.price(sample), order.lifetime_s, now, self.clock.boot(), entry.substitute_for,
        )  # fmt: skip
        self.journal.start(started)
        attempt = Attempt(started, self._job(started, dict(task)), now, same_boot=True)
        self.running[started.name] = attempt
        self.tries.started(sample.id)
        self._say(sample, "starts", attempt)
        try:
            self.runner.start(attempt.job)
        except LaunchRefused as no:
            attempt.ending = Progress(running=False, reason=no.reason, detail=no.detail, again=no.again, billed_s=0.0)
        except Unreachable as lost:
            self._say(sample, "lost contact", attempt, detail=str(lost))

    def _stop_what_does_not_fit(self) -> None:
        """A wall that has come nearer since they were started: the dearest machines are stopped first."""
        book, budget = self.journal.book, self.order.budget_usd
        going_on = [a for a in self.running.values() if a.ending is None]
        if budget is None or not overdrawn(book.spent_usd + book.committed_usd, budget):
            return
        left = budget - book.spent_usd
        for attempt in sorted(going_on, key=lambda a: (a.started.commitment_usd, a.started.name)):
            left -= attempt.started.commitment_usd
            if overdrawn(-left, 0.0):
                left += attempt.started.commitment_usd
                attempt.ending = attempt.stopped("budget", "running on could cost more than the budget")

    def _advance(self, attempt: Attempt) -> None:
        if attempt.ending is None:
            attempt.ending = self._look(attempt)
        if attempt.ending is not None and self.clock.now_s() >= attempt.end_after_s and self._ended(attempt):
            self._finish(attempt, attempt.ending)

    def _look(self, attempt: Attempt) -> Progress | None:
        """How the sample ended, or None while it runs."""
        sample, now = attempt.started.sample, self.clock.now_s()
        try:
            progress = within_attempt(self.runner.look(attempt.job), attempt.job.folder)
        except Unreachable as lost:
            self._say(sample, "lost contact", attempt, detail=str(lost))
            attempt.unheard(now)
        else:
            attempt.heard(progress)
            if not progress.running:
                return progress
            self._say(sample, "measures" if progress.ready else "sets up", attempt, progress=progress)
        if self.stopping():
            return attempt.stopped("interrupted", "stopped by its user")
        return attempt.overdue(self.clock.now_s(), self.order.deadline_s)

    def _ended(self, attempt: Attempt) -> bool:
        try:
            self.runner.end(attempt.job)
        except Unreachable as lost:
            # Clouds take a while; only what takes long is worth a word of why.
            long = attempt.ends >= SLOW_ENDS
            self._say(attempt.started.sample, "ends", attempt, detail=str(lost) if long else None)
            if attempt.not_ended(self.clock.now_s()):
                # It stays open in the journal: the next bench asks again, and its bill stays committed.
                self.left.append(attempt.started.name)
                del self.running[attempt.started.name]
            return False
        return True

    def _finish(self, attempt: Attempt, end: Progress) -> None:
        """Its machine is gone: it is paid, and then recorded, tried again, or measured on another machine."""
        started, sample = attempt.started, attempt.started.sample
        billed_s = attempt.billed_s(end, self.clock.now_s())
        # What was recorded was paid then, at that time's prices and rounding.
        recorded = end.recorded
        spent_usd = started.price_usd_per_hour * billed_s / 3600 if recorded is None else recorded.spent
        wanted = started.application == self.order.application and self.order.task(sample) is not None
        pause_s = None if self.stopping() or not wanted else self.tries.pause_s(sample.id, end)
        if not wanted or pause_s is not None:
            self.journal.end(started.name, spent_usd, None)
            self.ledger.paid(self.journal.book.spent_usd)
            if pause_s is not None:
                self.waiting.append(Queued(sample, self.clock.now_s() + pause_s, started.substitute_for))
            self._say(sample, "is tried again" if wanted else "is no longer wanted", attempt, detail=end.detail)
        else:
            if end.lost:
                end = replace(end, reason="interrupted", detail=end.detail or "its results are beyond reach")
            record = make_record(sample, end, self.order.rules, billed_s, spent_usd)
            record = record.model_copy(update={"substitute_for": started.substitute_for})
            self._record(started, record, end)
        del self.running[started.name]

    def _record(self, started: LaunchRecord, record: Measured, end: Progress) -> None:
        """Into the journal and the results; a machine that cannot be had gives its place to another."""
        root = started.substitute_for or started.sample.id
        queued = {entry.sample.id for entry in self.waiting}
        others = [] if self.stopping() else [one for one in self.order.instead(root) if one.id not in queued]
        other = self.tries.instead(started.sample, record.reason, others)
        if other is not None:
            said = filter(None, (record.detail, f"{other.id} takes its place"))
            record = record.model_copy(update={"detail": "; ".join(said)})
        record = self.ledger.keep(record, end.timings)
        self.journal.end(started.name, record.spent, record)
        self._write(started, record)
        if other is not None:
            self.waiting.append(Queued(other, substitute_for=root))

    def _write(self, started: LaunchRecord, record: Measured) -> None:
        self.ledger.put(record, self.journal.book.spent_usd)
        self.journal.written(started.name)
        self._say(started.sample, "is done", self.running.get(started.name), record=record)

    def _unaffordable(self, entry: Queued, commitment: float) -> None:
        left = (self.order.budget_usd or 0.0) - self.journal.book.spent_usd
        detail = f"would commit ${commitment:.4f}, and ${max(left, 0.0):.4f} of the budget is left"
        progress = Progress(running=False, reason="budget", detail=detail)
        record = make_record(entry.sample, progress, self.order.rules, 0.0, 0.0)
        record = record.model_copy(update={"substitute_for": entry.substitute_for})
        self.ledger.put(record, self.journal.book.spent_usd)
        self._say(entry.sample, "is done", record=record)

    def _end_all(self) -> None:
        for name, attempt in list(self.running.items()):
            try:
                self.runner.end(attempt.job)
            except Exception as problem:
                self.left.append(name)
                self._say(attempt.started.sample, "cannot be ended", attempt, detail=str(problem))

    def _say(
        self,
        sample: Sample,
        what: str,
        attempt: Attempt | None = None,
        progress: Progress | None = None,
        record: Measured | None = None,
        detail: str | None = None,
    ) -> None:
        book = self.journal.book
        folder = None if attempt is None else attempt.job.folder
        ends_s = None if attempt is None else attempt.since_s + self.order.deadline_s
        self.tell(Event(sample, what, book.spent_usd, book.committed_usd, progress, record, detail, folder, ends_s))
