"""Orphaned machines: no journal here lists them, because it was lost or the bench was killed on another host."""

from collections.abc import Sequence

from fogspec.backends.protocol import Unreachable
from fogspec.base.errors import CloudError, Refused
from fogspec.bench.campaign import Campaign
from fogspec.bench.journal import LaunchRecord
from fogspec.bench.types import SAMPLE_IN_NAME
from fogspec.plan.schema import Sample

ORPHAN = "unknown"


def adopt_orphans(campaign: Campaign, samples: Sequence[Sample], resume: bool, starts: bool = True) -> None:
    """Take over the application's machines that are not in the journal: they are taken down, and paid in full.

    Raise Refused unless `resume`, since a bench in another folder or on another host may still need them; CloudError if the
    backend cannot list them. A bench that starts nothing and has a journal need not list them.
    """
    backend, state, config = campaign.backend, campaign.journal.state, campaign.config
    if not (resume or starts or state.campaigns <= 1):
        return
    try:
        found = backend.list(config.owner, config.attempts)
    except Unreachable as lost:
        raise CloudError(f"which machines are up cannot be said: {lost}", "run the bench again") from None
    orphans = [name for name in found if config.owner.has_sample(name) and name not in state.open]
    if orphans and not resume:
        raise Refused(
            "machines of another bench of this application are up",
            *orphans,
            "let that bench finish where it runs; if it was killed, bench --resume takes them down",
        )
    for name in orphans:
        campaign.journal.start(_launch_record(campaign, name, samples))


def _launch_record(campaign: Campaign, name: str, samples: Sequence[Sample]) -> LaunchRecord:
    """Return a launch record for an orphan: from now, at the highest price its name can match, for its full lifetime."""
    rest = name.removeprefix(campaign.config.owner.prefix)
    matching = [one for one in samples if rest.startswith(f"{one.id[:SAMPLE_IN_NAME]}-")] or samples
    dearest = max(matching, key=campaign.price)
    return LaunchRecord(
        name=name,
        runner=campaign.backend.name,
        application=ORPHAN,
        sample=dearest,
        price_usd_per_hour=campaign.price(dearest),
        lifetime_s=campaign.config.lifetime_s,
        at_s=campaign.clock.now_s(),
        boot=ORPHAN,
    )
