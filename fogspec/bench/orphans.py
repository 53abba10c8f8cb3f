"""Machines that no journal here knows: the journal was lost, or the bench was killed on another host."""

from collections.abc import Sequence

from fogspec.backends.protocol import FindsStrays, LostContact
from fogspec.base.errors import CloudFailed, Refused
from fogspec.bench.campaign import Campaign
from fogspec.bench.journal import Started
from fogspec.bench.types import SAMPLE_IN_NAME
from fogspec.plan.schema import Sample

STRAY = "unknown"


def adopt_strays(campaign: Campaign, samples: Sequence[Sample], resume: bool, starts: bool = True) -> None:
    """Take machines of this application over that are not in the journal: they are taken down, and paid in full.

    Raises Refused unless that was asked for, since a bench in another folder or on another host may still need them;
    CloudFailed when the runner cannot be asked. A bench that starts nothing, with a journal, need not ask.
    """
    runner, book, prefix = campaign.runner, campaign.journal.book, campaign.order.prefix
    if not isinstance(runner, FindsStrays) or not (resume or starts or book.campaigns <= 1):
        return
    try:
        found = runner.strays(prefix, campaign.order.attempts)
    except LostContact as lost:
        raise CloudFailed(f"which machines are up cannot be said: {lost}", "run the bench again") from None
    strays = [name for name in found if name.startswith(prefix) and name not in book.open]
    if strays and not resume:
        raise Refused(
            "machines of another bench of this application are up", *strays,
            "let that bench finish where it runs; if it was killed, bench --resume takes them down",
        )  # fmt: skip
    for name in strays:
        campaign.journal.start(_started(campaign, name, samples))


def _started(campaign: Campaign, name: str, samples: Sequence[Sample]) -> Started:
    """As if it had been started now, at the price of the dearest sample that its name may mean, for all its lifetime."""
    words = name.removeprefix(campaign.order.prefix)
    meant = [one for one in samples if words.startswith(f"{one.id[:SAMPLE_IN_NAME]}-")] or samples
    dearest = max(meant, key=campaign.price)
    life_s = campaign.order.lifetime_s
    return Started(
        name, campaign.runner.name, STRAY, dearest, campaign.price(dearest), life_s, campaign.clock.now_s(), STRAY
    )
