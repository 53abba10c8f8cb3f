"""The fault campaign: `python -m tests.faults.campaign [BENCHES]` prints machines leaked, budgets exceeded, samples lost.

Every bench is a seed: its own faults, budget, number of samples and moments of kill -9. One base bench without
other faults is killed at each of its steps in turn, journal writes among them.
"""

import collections
import json
import math
import random
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from fogspec.results.schema import UNAVAILABLE, is_final
from tests.faults.controllers import COMMITMENT, bench
from tests.faults.simulation import World


class Tally(collections.Counter[str]):
    """Counts of benches, controllers, kills, faults and misdeeds."""

    def __init__(self, *words: object) -> None:
        super().__init__(*words)
        self.true_usd, self.billed_usd, self.worst = 0.0, 0.0, 1.0

    def billed(self, spent: Mapping[str, float], world: World) -> None:
        """Compare what the journal says with the provider's bill."""
        self.true_usd += world.bill
        self.billed_usd += sum(spent.values())
        if world.bill > 0:
            self.worst = max(self.worst, sum(spent.values()) / world.bill)

    def line(self) -> str:
        counts = ", ".join(f"{name} {self[name]}" for name in self)
        return f"{counts}, billed {self.billed_usd / self.true_usd:.3f} of the true bill, at most {self.worst:.2f}"


WRONG = ("machines leaked", "budgets exceeded", "machines under-billed", "finished samples lost", "measured twice",
         "other misdeeds")  # fmt: skip
UNWATCHED = "budgets passed by machines without an end of their own while nobody looked"
COMMITTED_S = COMMITMENT.paid_s


def over(world: World, budget: float | None) -> bool:
    """Whether the true bill passes the budget, but for machines without an end of their own that nobody looked after."""
    if budget is None or world.bill <= budget * (1 + 1e-9):
        return False
    beyond = sum(world.beyond_control(machine, COMMITTED_S) for machine in world.machines.values())
    return world.bill - beyond > budget * (1 + 1e-9)


def paid(world: World) -> dict[str, float]:
    """What the journal says that each machine cost."""
    entries = [json.loads(line) for line in (world.folder / "journal.jsonl").read_text().splitlines()]
    sums = collections.defaultdict[str, float](float)
    for entry in entries:
        if entry["do"] == "end":
            sums[entry["name"]] += entry["spent_usd"]
    return sums


def judge(world: World, budget: float | None, tally: Tally) -> None:
    """What must never happen, counted by what the world knows, not by what fogspec believes."""
    records = world.disk["samples"]
    tally["machines leaked"] += sum(m.ended is None or m.there(world.now) for m in world.machines.values())
    tally["budgets exceeded"] += over(world, budget)
    passed = budget is not None and world.bill > budget * (1 + 1e-9)
    tally[UNWATCHED] += passed and not over(world, budget)
    spent = paid(world)
    tally["machines under-billed"] += sum(
        spent[name] < machine.bill(world.now) * (1 - 1e-9) for name, machine in world.machines.items()
    )
    tally.billed(spent, world)
    by_sample = collections.defaultdict(list)
    for machine in world.machines.values():
        if machine.fetched:
            by_sample[machine.sample].append(machine)
    tally["measured twice"] += sum(len(machines) > 1 for machines in by_sample.values())
    for machines in by_sample.values():
        record = records.get(machines[0].sample)
        mean_s = record.latency.mean if record is not None and record.latency is not None else 0.0
        same = math.isclose(mean_s, machines[0].started + 1)
        tally["finished samples lost"] += not (same and is_final(record))
    tally["other misdeeds"] += len(world.misdeeds)


def run_one(seed: int, tally: Tally, kills: set[int] | None = None, faults: bool = True) -> World:
    """One bench to its end, with everything that is drawn from the seed."""
    chance = random.Random(f"bench {seed}")
    count = chance.randint(1, 9)
    budget = chance.choice([None, 0.05, 0.2, 0.5, 1.0, 3.0])
    if kills is None:
        kills = {chance.randint(1, 40 * count) for _ in range(chance.randint(0, 4))}
    else:
        count, budget = 3, 1.0
    with tempfile.TemporaryDirectory() as folder:
        world = World(seed, Path(folder), faults=faults, kills=kills)

        def check(now: World) -> None:
            tally["budgets exceeded"] += over(now, budget)

        tally["controllers"] += bench(world, budget, count, check)
        judge(world, budget, tally)
    tally["benches"] += 1
    tally["kills"] += sum(step <= world.steps for step in kills)
    tally["machines started"] += len(world.machines)
    tally["samples without a machine"] += sum(one.reason in UNAVAILABLE for one in world.disk["samples"].values())
    tally["samples finished"] += sum(map(is_final, world.disk["samples"].values()))
    return world


def run_forgetful(seed: int, tally: Tally) -> None:
    """A bench whose every next controller is on another host: no journal, only the results and the machines' names."""
    chance = random.Random(f"forgetful {seed}")
    count = chance.randint(1, 6)
    kills = {chance.randint(1, 30 * count) for _ in range(chance.randint(1, 4))}
    with tempfile.TemporaryDirectory() as folder:
        world = World(seed, Path(folder), kills=kills, forgets=True)
        bench(world, None, count, lambda _: None)
        tally["machines leaked"] += sum(m.there(world.now) for m in world.machines.values())
        tally["other misdeeds"] += len(world.misdeeds)
    tally["benches that lost their journal"] += 1


def main(benches: int = 1000, first: int = 0) -> Tally:
    """Random benches, then the base bench killed at every step, then benches that lose their journal."""
    names = ("benches", "benches that lost their journal", "controllers", "kills", "machines started",
             "samples without a machine", "samples finished", UNWATCHED, *WRONG)  # fmt: skip
    tally = Tally(dict.fromkeys(names, 0))
    for seed in range(first, first + benches):
        run_one(seed, tally)
    for step in range(1, run_one(0, tally, kills=set(), faults=False).steps + 1):
        run_one(0, tally, kills={step}, faults=False)
        run_one(0, tally, kills={step, step + 3}, faults=False)
    for seed in range(first, first + benches // 10):
        run_forgetful(seed, tally)
    return tally


if __name__ == "__main__":
    print(main(*map(int, sys.argv[1:2])).line())
