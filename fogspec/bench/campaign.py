"""A campaign: every sample to a record, within the budget, leaving nothing behind.

The loop never blocks: it starts what fits, polls what runs, stops what is over. Before a machine can cost
anything its start is in the journal; after it is verified gone its record is. So a controller may be killed
between any two steps, and the next one resumes from the journal.
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from fogspec.backends.protocol import Costs, Job, LaunchRefused, SampleBackend, SampleStatus, Unreachable
from fogspec.base import units
from fogspec.base.clock import Clock
from fogspec.base.clouds import cloud_name, split_infra
from fogspec.base.errors import Refused
from fogspec.bench.attempt import STOP_PATIENCE_S, Attempt, outlived
from fogspec.bench.journal import Journal, LaunchRecord
from fogspec.bench.record import make_record, within_attempt
from fogspec.bench.retry import RetryPolicy, overdrawn
from fogspec.bench.types import CampaignConfig, Event, EventKind, Queued, ResultsSink, SampleTask, measuring
from fogspec.plan.schema import Sample, replicate
from fogspec.results.schema import Measured

IDLE_S = 0.5
ABSENCE_S = 60.0  # without a look at any machine: this host was asleep
SLOW_STOPS = 4
MISTAKES = ("setup", "image", "crash", "no_response")  # reasons that are no matter of one machine
ALIKE = 2


@dataclass(slots=True, kw_only=True)
class Campaign:
    """One run of the loop over one results file.

    Once it is `halted` it starts nothing more, and waits for what runs. On a paid cloud that is not `proven`, where no request
    was answered so far, the cheapest machine starts alone: it shows mistakes for all. `left` has the names of machines that
    could not be verified gone; `denied` is why no machine is available at all, `denied_usd` what machines cost that were up
    when that was found out. `room` is for how many of its own machines a region has quota, where that was met.
    """

    config: CampaignConfig
    backend: SampleBackend
    journal: Journal
    sink: ResultsSink
    clock: Clock
    report: Callable[[Event], None] = lambda _event: None
    stopping: Callable[[], bool] = lambda: False
    halted: Callable[[], bool] = lambda: False
    running: dict[str, Attempt] = field(default_factory=dict)
    queue: list[Queued] = field(default_factory=list)
    retry: RetryPolicy = field(default_factory=RetryPolicy)
    proven: set[str] = field(default_factory=set)
    mistakes: Counter[tuple[str, str]] = field(default_factory=Counter)
    room: dict[str, int] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)
    unstopped: list[Attempt] = field(default_factory=list)
    looked_s: float | None = None
    denied: str | None = None
    denied_usd: float = 0.0

    def recover(self) -> set[str]:
        """Finish the work of an earlier controller: unwritten records, and machines that may still run.

        Return the ids of samples that are still running. Raise Refused if another backend started them.
        """
        for started, record in list(self.journal.state.unwritten.values()):
            if started.application == self.config.measured:
                self._write(started, record)
            else:
                self.journal.written(started.name)
        for started in list(self.journal.state.open.values()):
            if started.runner != self.backend.name:
                again = measuring(started.runner)
                raise Refused(f"a bench with the runner {started.runner} was interrupted", f"let it finish: {again}")
            self.running[started.name] = self._adopted(started)
        return {one.started.sample.id for one in self._continuing()}

    def run(self, samples: Sequence[Sample]) -> None:
        """Measure the samples, besides those that are still running from before, until nothing is left to do."""
        self.queue += [Queued(sample) for sample in samples]
        try:
            while self.queue or self.running:
                self._notice_absence()
                if self.stopping() or self.is_halted():
                    self.queue.clear()
                for attempt in self.running.values():
                    self._look_for(attempt)
                self._start_what_fits()
                self._stop_what_does_not_fit()
                for attempt in list(self.running.values()):
                    self._advance(attempt)
                if self.queue or self.running:
                    self._sleep(self._pause_s())
        except KeyboardInterrupt:  # at once: the journal has what may still run
            raise
        except BaseException:
            self._stop_all()
            raise

    def _notice_absence(self) -> None:
        """After this host was asleep, machines are watched as after a restart: they may have ended meanwhile."""
        now, before = self.clock.now_s(), self.looked_s
        self.looked_s = now
        if before is not None and now - before > ABSENCE_S:
            for attempt in self.running.values():
                attempt.found_s = now

    def _sleep(self, seconds: float) -> float:
        """Sleep; return for how much longer than that, as when this host was asleep: no patience is lost in that time.

        A cloud that takes long to answer is no reason for more patience.
        """
        before = self.clock.now_s()
        self.clock.sleep(seconds)
        longer_s = max(self.clock.now_s() - before - seconds, 0.0)
        for attempt in self.running.values():
            if attempt.give_up_s is not None:
                attempt.give_up_s += longer_s
        return longer_s

    def _pause_s(self) -> float:
        """Return the seconds until something may have changed; a wait for a retry is not spent polling."""
        if self.running:
            return self.backend.poll_s
        wait_s = min(entry.not_before_s for entry in self.queue) - self.clock.now_s()
        return max(self.backend.poll_s, min(wait_s, IDLE_S))

    def price(self, sample: Sample) -> float:
        """Return what its machine costs with this backend, disk and address included, in USD per hour."""
        return 0.0 if self.backend.costs == Costs.NOTHING else sample.machine.paid_usd_per_hour

    def most_usd(self, sample: Sample) -> float:
        """Return the most that a sample can cost with this backend."""
        return 0.0 if self.backend.costs == Costs.NOTHING else self.config.commitment.usd(sample.machine)

    def _continuing(self) -> list[Attempt]:
        return [attempt for attempt in self.running.values() if attempt.end is None]

    def _adopted(self, started: LaunchRecord) -> Attempt:
        now = self.clock.now_s()
        task = self.config.task(started.sample) if started.application == self.config.measured else None
        attempt = Attempt(
            started=started,
            job=self._job(started, task),
            since_s=now - started.age_s(self.clock),
            found_s=now,
        )
        self.retry.started(started.sample.id)
        if task is None:
            # It is no longer wanted: its machine is taken down, and paid.
            attempt.end = SampleStatus(running=False, lost=True)
        return attempt

    def _job(self, started: LaunchRecord, task: SampleTask | None) -> Job:
        return Job(
            name=started.name,
            owner=self.config.owner,
            work=None if task is None else task.work,
            task={} if task is None else task.task,
            root=self.config.root,
            directory=self.config.attempts / started.name,
            tree=self.config.tree,
            machine=started.sample.machine,
            lifetime_s=started.lifetime_s,
            replicate=replicate(started.sample.id),
        )

    def _start_what_fits(self) -> None:
        now = self.clock.now_s()
        for entry in list(self.queue):
            if entry.not_before_s > now or len(self.running) >= self.backend.at_once:
                continue
            if self._waits(entry) or self._has_no_room(entry.sample):
                continue
            commitment = self.most_usd(entry.sample)
            budget = self.config.budget_usd
            if budget is not None and overdrawn(self._bound_usd() + commitment, budget):
                if not self.running:
                    self.queue.remove(entry)
                    self._unaffordable(entry, commitment)
                continue
            self.queue.remove(entry)
            self._launch(entry, now)

    def _waits(self, entry: Queued) -> bool:
        """Return whether the cheapest machine of its cloud is to start before this one, or has not answered a request."""
        cloud = cloud_name(entry.sample.machine.infra)
        if cloud in self.proven or self.backend.costs != Costs.REAL:
            return False
        if any(cloud_name(one.started.sample.machine.infra) == cloud for one in self.running.values()):
            return True
        queued = (one.sample for one in self.queue if cloud_name(one.sample.machine.infra) == cloud)
        return min(queued, key=lambda one: one.machine.price).machine.price < entry.sample.machine.price

    def _has_no_room(self, sample: Sample) -> bool:
        """Return whether one of its own machines in the region has to end first, because together they use up the quota."""
        room = self.room.get(_region(sample))
        return room is not None and self._others(sample) >= room

    def _others(self, sample: Sample) -> int:
        """Return the number of machines in a sample's region, that of another attempt at it not included."""
        started = (one.started.sample for one in self.running.values())
        return sum(_region(one) == _region(sample) and one.id != sample.id for one in started)

    def is_halted(self) -> bool:
        """Return whether what ended shows that the others would end alike.

        Either it lacks what the spec expects, or on a paid cloud machines ended for one reason before any answered a request.
        """
        return self.halted() or any(n >= ALIKE and cloud not in self.proven for (cloud, _), n in self.mistakes.items())

    def _launch(self, entry: Queued, now: float) -> None:
        sample, config = entry.sample, self.config
        started = LaunchRecord(
            name=config.job_name(sample, self.journal.state.attempts + 1),
            runner=self.backend.name,
            application=config.measured,
            sample=sample,
            price_usd_per_hour=self.price(sample),
            lifetime_s=config.commitment.lifetime_s,
            paid_s=config.commitment.paid_s,
            at_s=now,
            at_unix_s=self.clock.unix_s(),
            boot=self.clock.boot(),
        )
        task = config.task(sample)
        if task is None:
            raise LookupError(f"{sample.id} has no task")
        job = self._job(started, task)
        self.journal.start(started)
        attempt = Attempt(started=started, job=job, since_s=now, found_s=now)
        self.running[started.name] = attempt
        self.retry.started(sample.id)
        self._report(sample, EventKind.STARTS, attempt)
        try:
            self.backend.start(attempt.job)
        except LaunchRefused as no:
            attempt.end = SampleStatus(running=False, reason=no.reason, detail=no.detail, again=no.again, billed_s=0.0)
        except Unreachable as lost:
            self._report(sample, EventKind.LOST_CONTACT, attempt, detail=str(lost))

    def _bound_usd(self) -> float:
        """Return the most that everything started so far costs: spent, committed, and by machines that outlived that."""
        state = self.journal.state
        return state.spent_usd + state.committed_usd + self._outlived_usd()

    def _outlived_usd(self) -> float:
        there = [*self.running.values(), *self.unstopped]
        records = [(one.started, one.outlived_s(self.clock)) for one in there]
        return sum(one.usd(one.paid_s + outlived_s) - one.commitment_usd for one, outlived_s in records)

    def _stop_what_does_not_fit(self) -> None:
        """If the budget was lowered since they were started, stop the most expensive machines first."""
        state, budget = self.journal.state, self.config.budget_usd
        if budget is None:
            return
        left = budget - state.spent_usd - self._outlived_usd()
        # What has just been found may be done: its results are fetched first.
        settled = [one for one in self._continuing() if not one.just_found(self.clock.now_s())]
        left -= sum(one.started.commitment_usd for one in self.running.values() if one not in settled)
        for attempt in sorted(settled, key=lambda a: (a.started.commitment_usd, a.started.name)):
            left -= attempt.started.commitment_usd
            if overdrawn(-left, 0.0):
                left += attempt.started.commitment_usd
                attempt.end = attempt.stopped("budget", "running on could cost more than the budget")

    def _advance(self, attempt: Attempt) -> None:
        if attempt.end is None:
            attempt.end = self._poll(attempt)
        if attempt.end is not None and self.clock.now_s() >= attempt.stop_after_s and self._stopped(attempt):
            self._finish(attempt, attempt.end)

    def _look_for(self, attempt: Attempt) -> None:
        """Find out whether a machine whose longest time is over has ended by itself, unobserved."""
        name = attempt.started.name
        if attempt.started.outlived or attempt.gone_s is not None or attempt.outlived_s(self.clock) <= 0:
            return
        with contextlib.suppress(Unreachable):
            if name in self.backend.list(self.config.owner, self.config.attempts):
                attempt.started = self.journal.outlived(name)
            else:
                attempt.gone_s = self.clock.now_s()

    def _poll(self, attempt: Attempt) -> SampleStatus | None:
        """Return the final status of the sample; None while it runs."""
        sample, now = attempt.started.sample, self.clock.now_s()
        try:
            status = within_attempt(self.backend.poll(attempt.job), attempt.job.directory)
        except Unreachable as lost:
            self._report(sample, EventKind.LOST_CONTACT, attempt, detail=str(lost))
            attempt.unreachable(now)
        else:
            attempt.reached(status)
            if not status.running:
                return status
            if status.so_far is not None and status.so_far.requests:
                self.proven.add(cloud_name(sample.machine.infra))
            kind = EventKind.MEASURES if status.ready else EventKind.SETS_UP
            self._report(sample, kind, attempt, status=status)
        if self.stopping():
            return attempt.stopped("interrupted", "stopped by its user")
        return attempt.overdue(self.clock.now_s(), self.config.commitment.deadline_s)

    def _stopped(self, attempt: Attempt) -> bool:
        """Stop the attempt; return whether its machine is verified gone."""
        try:
            attempt.machines = self.backend.stop(attempt.job)
        except Unreachable as lost:
            # Clouds take a while; the reason matters only if it takes long.
            detail = str(lost) if attempt.stops >= SLOW_STOPS else None
            self._report(attempt.started.sample, EventKind.ENDS, attempt, detail=detail)
            if attempt.not_stopped(self.clock.now_s()):
                # It stays open in the journal: the next bench stops it again, and its bill stays committed.
                self.left.append(attempt.started.name)
                self.unstopped.append(attempt)
                del self.running[attempt.started.name]
                if attempt.has_no_access and attempt.end is not None:
                    self._deny(attempt.end)
            return False
        return True

    def _finish(self, attempt: Attempt, end: SampleStatus) -> None:
        """Pay a machine that is gone, then record its sample, or retry it."""
        started, sample = attempt.started, attempt.started.sample
        billed_s = attempt.billed_s(end, self.clock)
        if (outlived_s := attempt.outlived_s(self.clock)) > 0 and end.recorded is None:
            end = replace(end, detail="; ".join(filter(None, (end.detail, outlived(outlived_s)))))
        # A recording was paid at that time's prices and rounding.
        recorded = end.recorded
        spent_usd = started.price_usd_per_hour * billed_s / 3600 if recorded is None else recorded.spent
        wanted = started.application == self.config.measured and self.config.task(sample) is not None
        if end.setup_s is not None:  # until its first request
            self.proven.add(cloud_name(sample.machine.infra))
        elif wanted and end.reason in MISTAKES and self.backend.costs == Costs.REAL:
            self.mistakes[cloud_name(sample.machine.infra), end.reason] += 1
        if end.reason == "access":
            # No machine can be had until its user has logged in, which says nothing about the sample: it gets no record.
            self.denied_usd += spent_usd
            if wanted and attempt.is_resumed and not self.stopping():  # the user may have logged in since
                self.queue.append(Queued(sample))
            else:
                self._deny(end)
            wanted = False
        pause_s = None if self.stopping() or not wanted else self.retry.pause_s(sample.id, end)
        if wanted and not self.stopping() and end.reason == "quota" and (others := self._others(sample)):
            self.room[_region(sample)], pause_s = others, 0.0  # they are its own, and will end
        if not wanted or pause_s is not None:
            self.journal.end(started.name, spent_usd, None, self.clock)
            self.sink.paid(sample, self.journal.state.spent_usd)
            if self.denied is None:
                if pause_s is not None:
                    self.queue.append(Queued(sample, self.clock.now_s() + pause_s))
                self._report(sample, EventKind.RETRIED if wanted else EventKind.UNWANTED, attempt, detail=end.detail)
        else:
            if end.lost:
                end = replace(end, reason="interrupted", detail=end.detail or "its results are beyond reach")
            record = make_record(sample, end, self.config.rules, billed_s, spent_usd)
            if record.state == "ok":
                self.proven.add(cloud_name(sample.machine.infra))
            self._record(started, record, end)
        del self.running[started.name]

    def _deny(self, end: SampleStatus) -> None:
        self.denied = end.detail or "no access"
        self.queue.clear()

    def _record(self, started: LaunchRecord, record: Measured, end: SampleStatus) -> None:
        """Write the record to the journal and the results."""
        record = self.sink.keep(record, end.timings)
        self.journal.end(started.name, record.spent, record, self.clock)
        self._write(started, record)

    def _write(self, started: LaunchRecord, record: Measured) -> None:
        self.sink.put(record, self.journal.state.spent_usd)
        self.journal.written(started.name)
        self._report(started.sample, EventKind.DONE, self.running.get(started.name), record=record)

    def _unaffordable(self, entry: Queued, commitment: float) -> None:
        left = (self.config.budget_usd or 0.0) - self.journal.state.spent_usd
        detail = f"would commit {units.dollars(commitment)}, and {units.dollars(max(left, 0.0))} of the budget is left"
        status = SampleStatus(running=False, reason="budget", detail=detail)
        record = make_record(entry.sample, status, self.config.rules, 0.0, 0.0)
        self.sink.put(record, self.journal.state.spent_usd)
        self._report(entry.sample, EventKind.DONE, record=record)

    def _stop_all(self) -> None:
        """Stop every machine, again and again until each is verified gone; `left` gets those that are not in time."""
        waiting, until_s = dict(self.running), self.clock.now_s() + STOP_PATIENCE_S
        while waiting:
            late = self.clock.now_s() >= until_s
            for name, attempt in list(waiting.items()):
                try:
                    self.backend.stop(attempt.job)
                except Exception as problem:
                    if late:
                        self.left.append(name)
                        with contextlib.suppress(Exception):
                            self._report(attempt.started.sample, EventKind.NOT_ENDED, attempt, detail=str(problem))
                else:
                    del waiting[name]
            if late:
                return
            if waiting:
                until_s += self._sleep(max(self.backend.poll_s, IDLE_S))

    def _report(
        self,
        sample: Sample,
        kind: EventKind,
        attempt: Attempt | None = None,
        *,
        status: SampleStatus | None = None,
        record: Measured | None = None,
        detail: str | None = None,
    ) -> None:
        state = self.journal.state
        event = Event(
            sample=sample,
            kind=kind,
            spent_usd=state.spent_usd,
            committed_usd=state.committed_usd,
            status=status,
            record=record,
            detail=detail,
            folder=None if attempt is None else attempt.job.directory,
            ends_s=None if attempt is None else attempt.since_s + self.config.commitment.deadline_s,
        )
        self.report(event)


def _region(sample: Sample) -> str:
    """Return the cloud and region of a sample's machine, to which a quota applies."""
    return "/".join(split_infra(sample.machine.infra)[:2])
