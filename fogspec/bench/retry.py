"""The policy for unavailable machines: whether a start is tried again, and after which pause."""

from dataclasses import dataclass, field

from fogspec.backends.protocol import SampleStatus

ATTEMPTS = 3
BACKOFF_S = (5.0, 30.0)
ROUNDING = 1e-12


def overdrawn(usd: float, budget_usd: float) -> bool:
    """Return whether a sum exceeds a budget by more than rounding errors."""
    return usd > budget_usd * (1 + ROUNDING) + ROUNDING


@dataclass(slots=True)
class RetryPolicy:
    """Counts the starts of each sample in this campaign, by its id."""

    count: dict[str, int] = field(default_factory=dict)

    def started(self, sample: str) -> None:
        """Count a start."""
        self.count[sample] = self.count.get(sample, 0) + 1

    def pause_s(self, sample: str, end: SampleStatus) -> float | None:
        """Return the seconds to wait before a retry; None if it cannot help, or was tried often enough."""
        attempts = self.count.get(sample, 1)
        if not (end.again or end.lost) or attempts >= ATTEMPTS:
            return None
        return BACKOFF_S[min(attempts, len(BACKOFF_S)) - 1]
