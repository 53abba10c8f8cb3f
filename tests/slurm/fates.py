"""What breaks in the life of a deployment on the cluster, and when: drawn from its seed."""

import random
from dataclasses import dataclass


@dataclass(frozen=True)
class Lane:
    """Nodes that only one life at a time uses, and the hardware that a spec admits there."""

    machines: tuple[str, ...]
    hardware: str


LANES = (
    Lane(("1CPU--2GB", "2CPU--4GB"), "cpus: 1..2, memory: 2GiB..4GiB, gpus: [none]"),
    Lane(("2CPU--16GB", "16CPU--32GB"), "cpus: 2..16, memory: 16GiB..32GiB, gpus: [none]"),
    Lane(("64CPU--128GB",), "cpus: 64, memory: 128GiB, gpus: [none]"),
    Lane(("4CPU--16GB--T4:1",), "cpus: 4, memory: 16GiB, gpus: [T4]"),
)
FAULTS = {
    "kill": "kill -9 of fogspec", "interrupt": "Ctrl-C", "insist": "Ctrl-C twice", "worker": "kill -9 of its worker",
    "server": "kill -9 of the API server with its executors", "lone server": "kill -9 of the API server, later of its orphans",
    "network": "network cut", "disk": "full disk", "clock": "clock jump", "machine": "machine lost", "node": "node down",
}  # fmt: skip
OF_A_COMMAND = ("kill", "interrupt", "insist", "worker")
# When: once this has happened, and up to so many seconds later.
MOMENTS = {
    "apply": {"begun": 4.0, "priced": 2.0, "starting": 20.0, "up": 25.0},
    "change": {"begun": 4.0, "starting": 20.0, "up": 25.0, "ending": 4.0},
    "down": {"begun": 10.0, "ending": 6.0},
}


@dataclass(frozen=True)
class Fault:
    """What breaks, how long after what."""

    name: str
    after: str
    delay_s: float


def drawn(seed: int, chance: random.Random) -> dict[str, list[Fault]]:
    """Faults of each step: kinds take turns by the seed, so that each has its share."""
    names = [list(FAULTS)[seed % len(FAULTS)], *chance.choices(list(FAULTS), k=chance.randint(0, 2))]
    found: dict[str, list[Fault]] = {step: [] for step in MOMENTS}
    for name in names:
        step = chance.choice(("apply", "apply", "change", "down"))
        after = chance.choice(list(MOMENTS[step]))
        found[step].append(Fault(name, after, chance.uniform(0, MOMENTS[step][after])))
    return found
