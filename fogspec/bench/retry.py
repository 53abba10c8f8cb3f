"""What is worth trying when a machine cannot be had: the same once more, another one in its place, or nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from fogspec.backends.protocol import Progress
from fogspec.plan.schema import Sample
from fogspec.plan.substitutes import other_region
from fogspec.results.schema import UNAVAILABLE

TRIES = 3
BACKOFF_S = (5.0, 30.0)
ROUNDING = 1e-12


def overdrawn(usd: float, budget_usd: float) -> bool:
    """Whether a sum is over a budget, whatever floats make of its last digit."""
    return usd > budget_usd * (1 + ROUNDING) + ROUNDING


@dataclass(slots=True)
class RetryPolicy:
    """How often each sample was started in this campaign, by its id."""

    count: dict[str, int] = field(default_factory=dict)

    def started(self, sample: str) -> None:
        """It was started once more."""
        self.count[sample] = self.count.get(sample, 0) + 1

    def pause_s(self, sample: str, end: Progress) -> float | None:
        """How long to wait before trying the same again; None where that cannot help, or was tried enough."""
        tries = self.count.get(sample, 1)
        if not (end.again or end.lost) or tries >= TRIES:
            return None
        return BACKOFF_S[min(tries, len(BACKOFF_S)) - 1]

    def instead(self, sample: Sample, reason: str | None, others: Sequence[Sample]) -> Sample | None:
        """The first of the other machines that was not tried yet; a quota is the same for all machines of a region."""
        if reason not in UNAVAILABLE:
            return None
        helps = (
            one for one in others
            if one.id not in self.count and (reason == "capacity" or other_region(one.machine, sample.machine))
        )  # fmt: skip
        return next(helps, None)
