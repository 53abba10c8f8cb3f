"""Machines that no journal here knows: the journal was lost, or the bench was killed on another host."""

from collections.abc import Sequence

from fogspec.backends.protocol import ListsMachines, Unreachable
from fogspec.base.errors import CloudError, Refused
from fogspec.bench.campaign import Campaign
from fogspec.bench.journal import LaunchRecord
from fogspec.bench.types import SAMPLE_IN_NAME
from fogspec.plan.schema import Sample

ORPHAN = "unknown"


def adopt_orphans(campaign: Campaign, samples: Sequence[Sample], resume: bool, starts: bool = True) -> None:
    """Take machines of this application over that are not in the journal: they are taken down, and paid in full.

    Raises Refused unless that was asked for, since a bench in another folder or on another host may still need them;
    CloudError when the runner cannot be asked. A bench that starts nothing, with a journal, need not ask.
    """
    runner, book, prefix = campaign.runner, campaign.journal.book, campaign.order.prefix
    if not isinstance(runner, ListsMachines) or not (resume or starts or book.campaigns <= 1):
        return
    try:
        found = runner.strays(prefix, campaign.order.attempts)
    except Unreachable as lost:
        raise CloudError(f"which machines are up cannot be said: {lost}", "run the bench again") from None
    strays = [name for name in found if name.startswith(prefix) and name not in book.open]
    if strays and not resume:
        raise Refused(
            "machines of another bench of this application are up", *strays,
            "let that bench finish where it runs; if it was killed, bench --resume takes them down",
        )  # fmt: skip
    for name in strays:
        campaign.journal.start(_started(campaign, name, samples))


def _started(campaign: Campaign, name: str, samples: Sequence[Sample]) -> LaunchRecord:
    """As if it had been started now, at the price of the dearest sample that its name may mean, for all its lifetime."""
    words = name.removeprefix(campaign.order.prefix)
    meant = [one for one in samples if words.startswith(f"{one.id[:SAMPLE_IN_NAME]}-")] or samples
    dearest = max(meant, key=campaign.price)
    life_s = campaign.order.lifetime_s
    return LaunchRecord(
        name, campaign.runner.name, ORPHAN, dearest, campaign.price(dearest), life_s, campaign.clock.now_s(), ORPHAN
    )
