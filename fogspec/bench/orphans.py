"""Orphaned machines: no journal here lists them, because it was lost or the bench was killed on another host."""

import contextlib
from collections.abc import Sequence

from fogspec.backends.protocol import Unreachable
from fogspec.base.errors import Busy, CloudError
from fogspec.bench.campaign import Campaign
from fogspec.bench.journal import ORPHAN, LaunchRecord
from fogspec.bench.types import SAMPLE_IN_NAME
from fogspec.plan.schema import Sample


def adopt_orphans(campaign: Campaign, samples: Sequence[Sample], resume: bool, starts: bool = True) -> None:
    """Take over the application's machines that are not in the journal: they are taken down, and paid in full.

    Raise Busy unless `resume`, since a bench in another folder or on another host may still need them; CloudError if the
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
    strangers = [name for name in orphans if name not in state.ended]
    if strangers and not resume:
        raise Busy(
            "machines of another bench of this application are up",
            *strangers,
            "let that bench finish where it runs; if it was killed, bench --resume takes them down",
        )
    for name in orphans:
        campaign.journal.start(_launch_record(campaign, name, samples))


def adopt_returned(campaign: Campaign) -> None:
    """Take over machines that were verified gone and are there again: clouds and their lists lag behind."""
    backend, state, config = campaign.backend, campaign.journal.state, campaign.config
    with contextlib.suppress(Unreachable):
        for name in backend.list(config.owner, config.attempts):
            if name in state.ended and name not in state.open:
                campaign.journal.start(state.ended[name])


def _launch_record(campaign: Campaign, name: str, samples: Sequence[Sample]) -> LaunchRecord:
    """Return a launch record for an orphan: of one that had ended since then, else from now, at the dearest that it can be."""
    if (before := campaign.journal.state.ended.get(name)) is not None:
        return before
    rest = name.removeprefix(campaign.config.owner.prefix)
    matching = [one for one in samples if rest.startswith(f"{one.id[:SAMPLE_IN_NAME]}-")] or samples
    dearest = max(matching, key=campaign.price)
    return LaunchRecord(
        name=name,
        runner=campaign.backend.name,
        application=ORPHAN,
        sample=dearest,
        price_usd_per_hour=campaign.price(dearest),
        lifetime_s=campaign.config.commitment.lifetime_s,
        paid_s=campaign.config.commitment.paid_s,
        at_s=campaign.clock.now_s(),
        at_unix_s=campaign.clock.unix_s(),
        boot=ORPHAN,
    )
