"""Controllers of a simulated cloud: what they are to measure, and how one goes on where another was killed."""

import os
from collections.abc import Callable

from fogspec.bench.campaign import Campaign
from fogspec.bench.orphans import adopt_orphans
from fogspec.bench.types import CampaignConfig, SampleTask
from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import Commitment
from fogspec.plan.schema import Sample
from fogspec.results.schema import is_final
from tests.faults.simulation import (
    AFTER_S,
    OWNER,
    RULES,
    SETUP_S,
    FaultyBackend,
    Killed,
    MortalJournal,
    SimulatedSink,
    VirtualClock,
    World,
)
from tests.support.jobs import WORK

COMMITMENT = Commitment(measuring_s=AFTER_S, setup_s=SETUP_S)


def samples(count: int) -> list[Sample]:
    return [
        Sample(
            id=f"s{n}", reason="",
            machine=Machine(infra="sim", instance=f"m{n}", cpus="2", memory="4GiB", price=f"${0.1 * (n + 1):.1f}/h"),
        )
        for n in range(count)
    ]  # fmt: skip


def measured(world: World) -> set[str]:
    """The ids of samples that were measured."""
    return {one.id for one in world.disk["samples"].values() if is_final(one)}


def bench(world: World, budget_usd: float | None, count: int, check: Callable[[World], None]) -> int:
    """Run benches, each after the other was killed, until one comes to its end; returns how many it took."""
    for number in range(1, 1000):
        controller = world.controller
        try:
            one_bench(world, controller, budget_usd, samples(count), check)
        except Killed:
            world.absent(world.chance.uniform(0, 900))
            if world.forgets:
                # The next controller is on another host, where there are only the results.
                (world.folder / "journal.jsonl").unlink(missing_ok=True)
                world.reboot()
            if world.chance.random() < 0.3:
                world.reboot()
        except OSError:
            world.trail.append("disk full")
        else:
            return number
    raise AssertionError(f"seed {world.seed} never ends: {world.trail[-20:]}")


def campaign_of(world: World, controller: int, budget: float | None, check: Callable[[World], None]) -> Campaign:
    """A controller's campaign in this world."""
    journal = MortalJournal(world.folder / "journal.jsonl", world, controller)
    config = CampaignConfig(
        owner=OWNER, measured="a", rules=RULES, budget_usd=budget,
        commitment=COMMITMENT, task=lambda _sample: SampleTask(WORK, {}), root=world.folder,
        attempts=world.folder / "attempts", token=f"{controller}x{os.urandom(2).hex()}",
    )  # fmt: skip
    return Campaign(
        config=config, backend=FaultyBackend(world, controller), journal=journal, sink=SimulatedSink(world, controller),
        clock=VirtualClock(world, controller), report=lambda _event: check(world),
        proven={"sim"} if world.seed % 2 == 0 else set(),
    )  # fmt: skip


def one_bench(
    world: World, controller: int, budget: float | None, wanted: list[Sample], check: Callable[[World], None]
) -> None:
    """One controller's life."""
    campaign = campaign_of(world, controller, budget, check)
    try:
        campaign.journal.begin("simulated", "a", "p", world.disk["spent"])
        adopt_orphans(campaign, wanted, resume=True)
        running = campaign.recover()
        campaign.run([s for s in wanted if s.id not in running | measured(world)])
        adopt_orphans(campaign, wanted, resume=True)
        campaign.recover()
        campaign.run([])
        if campaign.left:
            world.misdeeds.append(f"left: {campaign.left}")
    finally:
        campaign.journal.close()
