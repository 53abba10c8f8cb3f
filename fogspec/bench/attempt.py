"""One attempt at a sample: what was heard of it, when it is overdue, and how long it is paid for."""

from dataclasses import dataclass, replace

from fogspec.backends.protocol import Job, Progress
from fogspec.bench.journal import LaunchRecord
from fogspec.results.schema import Reason

END_BACKOFF_S = 30.0
END_PATIENCE_S = 900.0
SILENCE_S = 120.0


@dataclass(slots=True)
class Attempt:
    """A machine that was started, until it is verified gone.

    `since_s` is when it was started, by a clock that may be compared with that moment only if `same_boot`. `ending`
    says how it ended, `again` whether trying again soon can help.
    """

    started: LaunchRecord
    job: Job
    since_s: float
    same_boot: bool
    ending: Progress | None = None
    again: bool = False
    last: Progress | None = None
    silent_s: float | None = None
    end_after_s: float = 0.0
    give_up_s: float | None = None
    ends: int = 0

    def heard(self, progress: Progress) -> None:
        """The runner knows this of it."""
        self.last, self.silent_s = progress, None

    def unheard(self, now_s: float) -> None:
        """The runner could not tell."""
        self.silent_s = now_s if self.silent_s is None else self.silent_s

    def stopped(self, reason: Reason, detail: str) -> Progress:
        """How it ends when it is stopped for a reason that is not its own."""
        return replace(self._so_far(), reason=reason, detail=detail)

    def overdue(self, now_s: float, deadline_s: float) -> Progress | None:
        """How it ends for having taken longer than `deadline_s`; None while it has not.

        Silence at the wrong moment is not the end: what was measured may still be fetched.
        """
        patient = self.silent_s is not None and now_s - self.silent_s < SILENCE_S
        if now_s - self.since_s < deadline_s or patient:
            return None
        so_far, limit = self._so_far(), f"{deadline_s:g} s"
        if self.last is None:
            return replace(so_far, reason="no_response", detail=f"nothing was heard of the machine for {limit}")
        if not so_far.ready:
            return replace(so_far, reason="setup", detail=f"not ready after {limit}")
        return replace(so_far, detail=f"ended by force after {limit}")

    def not_ended(self, now_s: float) -> bool:
        """It could not be verified gone: when to ask again; True when there is no use in asking any more."""
        if self.give_up_s is None:
            self.give_up_s = max(now_s, self.since_s + self.started.lifetime_s) + END_PATIENCE_S
        self.ends += 1
        self.end_after_s = now_s + min(END_BACKOFF_S, 2.0**self.ends)
        return now_s >= self.give_up_s

    def billed_s(self, end: Progress, now_s: float) -> float:
        """How long its machine is paid for.

        Over a restart of this host nothing tells how long the machine ran: the most it can be is billed.
        """
        if end.billed_s is not None:
            return end.billed_s
        lifetime_s = self.started.lifetime_s
        return min(now_s - self.since_s, lifetime_s) if self.same_boot else lifetime_s

    def _so_far(self) -> Progress:
        return replace(self.last or Progress(running=False), running=False)
