"""A cloud that fails, under a virtual clock: machines, their bills, and a controller that is killed anywhere.

The journal, the campaign and the collecting of timings are the real ones; only machines, time and the results'
disk are made up. Nothing that a killed controller does afterwards has any effect.
"""

import json
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job, LaunchRefused, SampleStatus, Unreachable
from fogspec.bench.journal import Journal
from fogspec.results.requests import RecordRules
from fogspec.results.schema import Measured, is_final

OWNER = Owner("a repository", "default", "a")
SETUP_S, AFTER_S, SLACK_S = 120.0, 300.0, 120.0
RULES = RecordRules(warmup=1, valid=0.9, statistic="mean")


class Killed(BaseException):
    """kill -9: whoever raises this does nothing any more."""


@dataclass
class Machine:
    """A simulated machine; times are the world's. `fate`: finishes, hangs, crashes, vanishes, writes nonsense."""

    sample: str
    price: float
    started: float
    lifetime: float
    fate: str
    ready: float
    done: float
    ended: float | None = None
    fetched: bool = False

    def up(self, now: float) -> bool:
        return self.ended is None and now < self.started + self.lifetime

    def bill(self, now: float) -> float:
        end = min(now if self.ended is None else self.ended, self.started + self.lifetime)
        return self.price * (end - self.started) / 3600


def _sample_of(name: str) -> str:
    """The id of the sample that a job of this name measures."""
    return name.removeprefix(OWNER.prefix).rsplit("-", 2)[0]


@dataclass
class World:
    """Everything that survives a controller. `chances` are probabilities of faults, `kills` when to kill."""

    seed: int
    folder: Path
    faults: bool = True
    kills: set[int] = field(default_factory=set)
    forgets: bool = False
    now: float = 0.0
    boot: int = 0
    boot_at: float = 0.0
    steps: int = 0
    controller: int = 0
    machines: dict[str, Machine] = field(default_factory=dict)
    disk: dict[str, Any] = field(default_factory=lambda: {"spent": 0.0, "samples": {}})
    trail: list[str] = field(default_factory=list)
    misdeeds: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.chance = random.Random(self.seed)

    def happens(self, probability: float) -> bool:
        return self.faults and self.chance.random() < probability

    def step(self, controller: int, what: str) -> None:
        """A point where the controller may be killed; raises Killed, for a dead one always."""
        if controller != self.controller:
            raise Killed
        self.steps += 1
        if self.steps in self.kills:
            self.trail.append(f"killed at {what}")
            self.controller += 1
            raise Killed

    @property
    def bill(self) -> float:
        return sum(machine.bill(self.now) for machine in self.machines.values())


@dataclass
class VirtualClock:
    """The host's clock; it starts anew with each boot, and a host may be suspended while it waits."""

    world: World
    controller: int

    def now_s(self) -> float:
        return self.world.now - self.world.boot_at

    def boot(self) -> str:
        return f"boot {self.world.boot}"

    def sleep(self, seconds: float) -> None:
        self.world.step(self.controller, "sleep")
        self.world.now += seconds + (self.world.chance.uniform(100, 2000) if self.world.happens(0.002) else 0)


@dataclass
class FaultyBackend:
    """Machines that fail in every way the protocol knows, and a network that fails beside them."""

    world: World
    controller: int
    name: str = "simulated"
    source: str | None = None
    at_once: int = 4
    poll_s: float = 10.0
    costs: str = "real"

    def start(self, job: Job) -> None:
        world = self.world
        world.step(self.controller, "before launch")
        if job.name in world.machines:
            world.misdeeds.append(f"{job.name} was started twice")
        if world.happens(0.15):
            reason = world.chance.choice(["capacity", "capacity", "quota"])
            raise LaunchRefused(reason, "no such machine left", again=world.happens(0.4))
        fate = world.chance.choices(
            ["finishes", "hangs", "never ready", "crashes", "vanishes", "partial", "no room"], [64, 6, 6, 6, 6, 6, 6]
        )[0]
        now, life = world.now, job.lifetime_s
        ready = now + world.chance.uniform(20, 100)
        fate = fate if world.faults else "finishes"
        done = ready + world.chance.uniform(5, AFTER_S) if fate not in ("hangs", "never ready") else now + 1e9
        world.machines[job.name] = Machine(
            _sample_of(job.name), job.machine.price, now, life, fate,
            ready if fate != "never ready" else now + 1e9, done,
        )  # fmt: skip
        world.step(self.controller, "after launch")
        if world.happens(0.05):
            raise Unreachable("the answer to the launch was lost")

    def poll(self, job: Job) -> SampleStatus:
        world = self.world
        world.step(self.controller, "poll")
        timings = job.directory / "timings.jsonl"
        machine = world.machines.get(job.name)
        if machine is not None and machine.fetched:
            return self._finished(machine, timings)
        if world.happens(0.1):
            raise Unreachable("no route to host")
        if machine is None or not machine.up(world.now) or (machine.fate == "vanishes" and world.now >= machine.done):
            return SampleStatus(running=False, lost=True, detail="the machine is not there")
        if machine.fate == "no room" and world.now >= machine.ready:
            machine.ended = machine.started if machine.ended is None else machine.ended
            return SampleStatus(running=False, reason="capacity", again=world.happens(0.3), billed_s=0.0)
        if world.now < machine.done:
            return SampleStatus(running=True, ready=world.now >= machine.ready, measured_on="simulated")
        job.directory.mkdir(parents=True, exist_ok=True)
        write_timings(timings, machine)
        machine.fetched = True
        world.step(self.controller, "fetched")
        return self._finished(machine, timings)

    def _finished(self, machine: Machine, timings: Path) -> SampleStatus:
        reason = "crash" if machine.fate == "crashes" else None
        return SampleStatus(running=False, timings=timings, reason=reason, measured_on="simulated")

    def list(self, owner: Owner, directory: Path) -> list[str]:
        world = self.world
        world.step(self.controller, "list")
        return [name for name, one in world.machines.items() if owner.has(name) and one.up(world.now)]

    def stop(self, job: Job) -> None:
        world = self.world
        world.step(self.controller, "before end")
        if world.happens(0.1):
            raise Unreachable("no route to host")
        machine = world.machines.get(job.name)
        if machine is not None and machine.ended is None:
            machine.ended = min(world.now, machine.started + machine.lifetime)
        world.step(self.controller, "after end")
        if world.happens(0.05):
            raise Unreachable("ended, but nobody said so")


def write_timings(path: Path, machine: Machine) -> None:
    """Ten requests, whose latency tells machines apart; a partial file ends in the middle of a line."""
    latency = machine.started + 1.0
    line = json.dumps({"name": "plan", "start_s": 0, "latency_s": latency, "ok": True, "metrics": {}, "reason": None})
    text = "\n".join([line] * 10) + "\n"
    path.write_text(text[: len(text) - 25] if machine.fate == "partial" else text)


@dataclass
class SimulatedSink:
    """The results' disk: a write happens whole or not at all."""

    world: World
    controller: int

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        self.world.step(self.controller, "keep timings")
        return record

    def paid(self, spent_usd: float) -> None:
        self.world.step(self.controller, "before paid")
        self.world.disk = {**self.world.disk, "spent": spent_usd}

    def put(self, record: Measured, spent_usd: float) -> None:
        world = self.world
        world.step(self.controller, "before results")
        if world.happens(0.005):
            raise OSError(28, "No space left on device")
        before = world.disk["samples"].get(record.id)
        if before is not None and is_final(before) and before != record:
            world.misdeeds.append(f"{record.id} was measured again")
        world.disk = {"spent": spent_usd, "samples": {**world.disk["samples"], record.id: record}}
        world.step(self.controller, "after results")


class MortalJournal(Journal):
    """The real journal; the controller may be killed before, in the middle of and after a write."""

    def __init__(self, path: Path, world: World, controller: int) -> None:
        self._world, self._controller = world, controller
        super().__init__(path, sync=lambda _fd: world.step(controller, "sync") if world.machines else None)

    def append(self, **entry: Any) -> None:
        world = self._world
        try:
            world.step(self._controller, f"before journal {entry['do']}")
        except Killed:
            # Half a line may be on disk.
            line = json.dumps(entry, sort_keys=True)
            if world.controller == self._controller + 1 and world.chance.random() < 0.7:
                self._file.write(line[: world.chance.randrange(len(line))].encode())
            raise
        if world.happens(0.005):
            raise OSError(28, "No space left on device")
        super().append(**entry)
        world.step(self._controller, f"after journal {entry['do']}")
