"""Two benches of one application at once, from two clones over one simulated engine, in many interleavings."""

import random
import threading
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fogspec.base.errors import Busy
from fogspec.bench.campaign import Campaign
from fogspec.bench.claim import ClaimingBackend
from fogspec.bench.journal import Journal
from fogspec.bench.orphans import adopt_orphans
from fogspec.bench.types import CampaignConfig, SampleTask
from tests.faults.controllers import COMMITMENT, samples
from tests.faults.simulation import OWNER, RULES, FaultyBackend, SimulatedSink, VirtualClock, World
from tests.support.jobs import WORK

TOKENS = ("0aaaaaaa", "1bbbbbbb")
HANGS_S = 120.0  # it only bounds hangs
UP = "machines of another bench of this application are up"
AT_ONCE = "another bench of this application started at the same time: this one ends its machine"


class Turns:
    """One thread runs at a time; which one is drawn at every step."""

    def __init__(self, seed: int) -> None:
        self.chance, self.change = random.Random(seed), threading.Condition()
        self.alive, self.turn = [0, 1], 0

    def await_turn(self, me: int) -> None:
        with self.change:
            assert self.change.wait_for(lambda: self.turn == me, HANGS_S)

    def step(self, me: int) -> None:
        with self.change:
            self.turn = self.chance.choice(self.alive)
            self.change.notify_all()
        self.await_turn(me)

    def end(self, me: int) -> None:
        with self.change:
            self.alive.remove(me)
            self.turn = self.alive[0] if self.alive else -1
            self.change.notify_all()


@dataclass
class Shared(World):
    """A world with two controllers: lists show each machine late, and each by another delay."""

    claims: list[ClaimingBackend] = field(default_factory=list)
    ever: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.turns = Turns(self.seed)

    def step(self, controller: int, what: str) -> None:
        self.turns.step(controller)
        for machine in self.machines.values():
            machine.lag = machine.lag or self.chance.uniform(0.1, 30.0)
        holding = {me for me, claim in enumerate(self.claims) if claim.held}
        self.ever |= holding
        if len(holding) > 1:
            self.misdeeds.append(f"both hold the claim at {what}")
        for me, token in enumerate(TOKENS):
            up = [name for name, one in self.machines.items() if f"-{token}-" in name and one.up(self.now)]
            if len(up) > 1 and me not in self.ever:
                self.misdeeds.append(f"{up} run without a claim at {what}")


def campaign_of(world: Shared, me: int) -> Campaign:
    folder = world.folder / str(me)
    folder.mkdir()
    journal, clock = Journal(folder / "journal.jsonl", sync=lambda _: None), VirtualClock(world, me)
    config = CampaignConfig(
        owner=OWNER, measured="a", rules=RULES, budget_usd=None, commitment=COMMITMENT,
        task=lambda _sample: SampleTask(WORK, {}), root=folder, attempts=folder / "attempts", token=TOKENS[me],
    )  # fmt: skip
    claim = ClaimingBackend(
        FaultyBackend(world, me), owner=OWNER, directory=config.attempts, token=TOKENS[me],
        ours=lambda: journal.state.open, now_s=clock.now_s,
    )  # fmt: skip
    world.claims.append(claim)
    return Campaign(config=config, backend=claim, journal=journal, sink=SimulatedSink(world, me), clock=clock)


def life(world: Shared, me: int, campaign: Campaign, outcomes: dict[int, str]) -> None:
    world.turns.await_turn(me)
    try:
        campaign.journal.begin("simulated", "a", "p", 0.0)
        adopt_orphans(campaign, samples(3), resume=False)
        campaign.run(samples(3))
        outcomes[me] = "done"
    except Busy as no:
        outcomes[me] = no.message
    except BaseException as wrong:
        outcomes[me] = repr(wrong)
    finally:
        world.turns.end(me)
        campaign.journal.close()


def race(seed: int, folder: Path) -> tuple[Shared, dict[int, str]]:
    """Both benches, from the same moment until both have ended."""
    folder.mkdir()
    world, outcomes = Shared(seed, folder, faults=False), dict[int, str]()
    campaigns = [campaign_of(world, me) for me in (0, 1)]
    threads = [threading.Thread(target=life, args=(world, me, campaigns[me], outcomes), daemon=True) for me in (0, 1)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(HANGS_S)
    return world, outcomes


@pytest.mark.parametrize("seeds", [range(60), range(60, 120)], ids=["0-59", "60-119"])
def test_of_two_benches_at_most_one_holds_the_claim(tmp_path: Path, seeds: range) -> None:
    seen: list[str] = []
    for seed in seeds:
        world, outcomes = race(seed, tmp_path / str(seed))
        # The simulated disk is one; clones have results of their own.
        assert [one for one in world.misdeeds if not one.endswith("was measured again")] == [], seed
        assert [name for name, one in world.machines.items() if one.ended is None and one.up(world.now)] == [], seed
        assert set(outcomes.values()) <= {"done", UP, AT_ONCE}, (seed, outcomes)
        seen += outcomes.values()
    assert seen.count(AT_ONCE) >= 3, "some of them started in the same moment"
    assert seen.count("done") >= len(seeds) // 2
