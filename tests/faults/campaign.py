"""The fault campaign: `python -m tests.faults.campaign [BENCHES]` prints machines leaked, budgets exceeded, samples lost.

Every bench is a seed: its own faults, budget, number of samples and moments of kill -9. One base bench without
other faults is killed at each of its steps in turn, journal writes among them.
"""

import collections
import math
import random
import sys
import tempfile
from pathlib import Path

from fogspec.effects.collecting import finished
from tests.faults.simulation import World, bench


class Tally(collections.Counter[str]):
    """Counts of benches, controllers, kills, faults and misdeeds."""

    def line(self) -> str:
        return ", ".join(f"{name} {self[name]}" for name in self)


WRONG = ("machines leaked", "budgets exceeded", "finished samples lost", "measured twice", "other misdeeds")


def judge(world: World, budget: float | None, tally: Tally) -> None:
    """What must never happen, counted by what the world knows, not by what fogspec believes."""
    records = world.disk["samples"]
    tally["machines leaked"] += sum(m.ended is None for m in world.machines.values())
    tally["budgets exceeded"] += budget is not None and world.bill > budget * (1 + 1e-9)
    by_sample = collections.defaultdict(list)
    for machine in world.machines.values():
        if machine.fetched:
            by_sample[machine.sample].append(machine)
    tally["measured twice"] += sum(len(machines) > 1 for machines in by_sample.values())
    for name, machines in by_sample.items():
        record = records.get(name)
        mean_s = record.latency.mean if record is not None and record.latency is not None else 0.0
        same = math.isclose(mean_s, machines[0].started + 1)
        tally["finished samples lost"] += not (same and finished(record))
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
            tally["budgets exceeded"] += budget is not None and now.bill > budget * (1 + 1e-9)

        tally["controllers"] += bench(world, budget, count, check)
        judge(world, budget, tally)
    tally["benches"] += 1
    tally["kills"] += sum(step <= world.steps for step in kills)
    tally["machines started"] += len(world.machines)
    tally["samples finished"] += sum(map(finished, world.disk["samples"].values()))
    return world


def main(benches: int = 1000) -> Tally:
    """Random benches, then the base bench killed at every step."""
    tally = Tally(dict.fromkeys(("benches", "controllers", "kills", "machines started", "samples finished", *WRONG), 0))
    for seed in range(benches):
        run_one(seed, tally)
    for step in range(1, run_one(0, tally, kills=set(), faults=False).steps + 1):
        run_one(0, tally, kills={step}, faults=False)
        run_one(0, tally, kills={step, step + 3}, faults=False)
    return tally


if __name__ == "__main__":
    print(main(*map(int, sys.argv[1:2])).line())
