"""One attempt at a sample: its last status, its deadline, and the time that is billed."""

from dataclasses import dataclass, replace

from fogspec.backends.protocol import Job, SampleStatus
from fogspec.bench.journal import LaunchRecord
from fogspec.results.schema import Reason

STOP_BACKOFF_S = 30.0
STOP_PATIENCE_S = 900.0
SILENCE_S = 120.0


@dataclass(slots=True, kw_only=True)
class Attempt:
    """A machine that was started, until it is verified gone.

    `since_s` is when it was started, by a clock that can be compared with that moment only if `same_boot`. `end` is the final
    status, from when the machine is to be stopped. `silent_s` is since when the backend could not reach it, `stops` how often
    it was stopped without success, `stop_after_s` when to try again and `give_up_s` when no longer.
    """

    started: LaunchRecord
    job: Job
    since_s: float
    same_boot: bool
    end: SampleStatus | None = None
    last: SampleStatus | None = None
    silent_s: float | None = None
    stop_after_s: float = 0.0
    give_up_s: float | None = None
    stops: int = 0

    def reached(self, status: SampleStatus) -> None:
        """Take the status that the backend returned."""
        self.last, self.silent_s = status, None

    def unreachable(self, now_s: float) -> None:
        """Remember since when the backend has not reached it."""
        self.silent_s = now_s if self.silent_s is None else self.silent_s

    def stopped(self, reason: Reason, detail: str) -> SampleStatus:
        """Return the final status of an attempt that is stopped for a reason that is not its own."""
        return replace(self._latest(), reason=reason, detail=detail)

    def overdue(self, now_s: float, deadline_s: float) -> SampleStatus | None:
        """Return the final status after `deadline_s`; None before.

        A short silence at the deadline is waited out: the measurements may still be fetched.
        """
        patient = self.silent_s is not None and now_s - self.silent_s < SILENCE_S
        if now_s - self.since_s < deadline_s or patient:
            return None
        latest, limit = self._latest(), f"{deadline_s:g} s"
        if self.last is None:
            return replace(latest, reason="no_response", detail=f"nothing was heard of the machine for {limit}")
        if not latest.ready:
            return replace(latest, reason="setup", detail=f"not ready after {limit}")
        return replace(latest, detail=f"ended by force after {limit}")

    def not_stopped(self, now_s: float) -> bool:
        """Set when to stop it again after a failure to verify that it is gone; return True to give up."""
        if self.give_up_s is None:
            self.give_up_s = max(now_s, self.since_s + self.started.lifetime_s) + STOP_PATIENCE_S
        self.stops += 1
        self.stop_after_s = now_s + min(STOP_BACKOFF_S, 2.0**self.stops)
        return now_s >= self.give_up_s

    def billed_s(self, end: SampleStatus, now_s: float) -> float:
        """Return the seconds for which its machine is paid.

        Over a restart of this host, the running time is unknown: the whole lifetime is billed.
        """
        if end.billed_s is not None:
            return end.billed_s
        lifetime_s = self.started.lifetime_s
        return min(now_s - self.since_s, lifetime_s) if self.same_boot else lifetime_s

    def _latest(self) -> SampleStatus:
        return replace(self.last or SampleStatus(running=False), running=False)
