"""One attempt at a sample: its last status, its deadline, and the time that is billed."""

from dataclasses import dataclass, replace

from fogspec.backends.protocol import Job, SampleStatus
from fogspec.base.clock import Clock
from fogspec.base.clouds import cloud_of
from fogspec.base.units import shown_duration
from fogspec.bench.journal import LaunchRecord
from fogspec.plan.commitment import PATIENCE_S, TEARDOWN_S
from fogspec.results.schema import Reason

STOP_BACKOFF_S = 30.0
STOP_PATIENCE_S = 900.0
NO_ACCESS_PATIENCE_S = 180.0
NO_MACHINE: tuple[Reason, ...] = ("access", "quota", "capacity")  # reasons why a machine is unavailable


@dataclass(slots=True, kw_only=True)
class Attempt:
    """A machine that was started, until it is verified gone.

    `since_s` is when it was started, by the clock of this boot and, if it was started in another, the wall clock.
    `found_s` is when this controller began to watch it: at its start, or after an absence. `was_ready` tells that it was seen
    to measure. `end` is the final status, from when the machine is to be stopped. `gone_s` is when it was looked for, after
    its longest time was over, and had ended by itself. `silent_s` is since when the backend could not reach it,
    `stops` how often it was stopped without success, `stop_after_s` when to try again and `give_up_s` when no longer.
    `machines` is how many its provider says that there were; None if it does not say.
    """

    started: LaunchRecord
    job: Job
    since_s: float
    found_s: float
    was_ready: bool = False
    end: SampleStatus | None = None
    last: SampleStatus | None = None
    gone_s: float | None = None
    silent_s: float | None = None
    stop_after_s: float = 0.0
    give_up_s: float | None = None
    stops: int = 0
    machines: int | None = None

    @property
    def has_no_access(self) -> bool:
        """Whether it ended because the cloud gives no access to its user."""
        return self.end is not None and self.end.reason == "access"

    @property
    def is_resumed(self) -> bool:
        """Whether an earlier controller started it."""
        return self.found_s > self.since_s

    def reached(self, status: SampleStatus) -> None:
        """Take the status that the backend returned."""
        self.last, self.silent_s = status, None
        self.was_ready = self.was_ready or (status.running and status.ready)

    def unreachable(self, now_s: float) -> None:
        """Remember since when the backend has not reached it."""
        self.silent_s = now_s if self.silent_s is None else self.silent_s

    def stopped(self, reason: Reason, detail: str) -> SampleStatus:
        """Return the final status of an attempt that is stopped for a reason that is not its own."""
        return replace(self._latest(), reason=reason, detail=detail)

    def overdue(self, now_s: float, deadline_s: float) -> SampleStatus | None:
        """Return the final status after `deadline_s`; None before.

        A short silence at the deadline is waited out, and so is a short time after an absence: the measurements may still
        be fetched.
        """
        patient = self.silent_s is not None and now_s - self.silent_s < PATIENCE_S
        if now_s - self.since_s < deadline_s or patient or self.just_found(now_s):
            return None
        latest, limit = self._latest(), f"{deadline_s:g} s"
        if self.last is None:
            return replace(latest, reason="no_response", detail=f"nothing was heard of the machine for {limit}")
        if not latest.ready:
            return replace(latest, reason="setup", detail=f"not ready after {limit}")
        return replace(latest, detail=f"ended by force after {limit}")

    def just_found(self, now_s: float) -> bool:
        """Return whether this controller began to watch it only now: it may be over, and nothing was heard of it yet."""
        return self.is_resumed and now_s - self.found_s < PATIENCE_S

    def not_stopped(self, now_s: float) -> bool:
        """Set when to stop it again after a failure to verify that it is gone; return True to give up.

        Without access to the cloud that is soon: its user has to log in first.
        """
        if self.give_up_s is None and self.has_no_access:
            self.give_up_s = now_s + NO_ACCESS_PATIENCE_S
        elif self.give_up_s is None:
            self.give_up_s = max(now_s, self.since_s + self.started.paid_s) + STOP_PATIENCE_S
        self.stops += 1
        self.stop_after_s = now_s + min(STOP_BACKOFF_S, 2.0**self.stops)
        return now_s >= self.give_up_s

    def outlived_s(self, clock: Clock) -> float:
        """Return for how long it has been there beyond the longest time that was committed, as far as is known."""
        return 0.0 if self.gone_s is not None else max(self.started.passed_s(clock) - self.started.paid_s, 0.0)

    def billed_s(self, end: SampleStatus, clock: Clock) -> float:
        """Return the seconds for which its machine is paid, now that it is verified gone: those since its start, for each that
        its provider says there was, as its cloud bills.

        The end of one that ended during an absence was not observed: it came after the longest time that was committed at the
        latest, or when the request of an earlier controller to end it was carried out. Nothing is paid where it is certain that
        there was no machine, or where none could be had and its provider, which lists those that have ended, has none. Neither
        is believed of a machine that was seen to measure.
        """
        if end.billed_s is not None and (end.billed_s > 0 or not (self.was_ready or self.machines)):
            return end.billed_s
        if self.machines == 0 and end.reason in NO_MACHINE and not (self.was_ready or self.is_resumed):
            return 0.0
        return cloud_of(self.started.sample.machine.infra).billed_s(self._paid_s(clock)) * (self.machines or 1)

    def _paid_s(self, clock: Clock) -> float:
        passed_s = self.started.passed_s(clock)
        if self.gone_s is None:
            return passed_s
        since_gone_s = clock.now_s() - self.gone_s
        return min(passed_s - since_gone_s, self.started.paid_s + TEARDOWN_S) + since_gone_s

    def _latest(self) -> SampleStatus:
        return SampleStatus(running=False) if self.last is None else replace(self.last, running=False)


def outlived(seconds: float) -> str:
    """Return what to say of a machine that was there longer than it should have been."""
    return f"its machine did not end by itself and was paid for {shown_duration(round(seconds))} longer than its longest time"
