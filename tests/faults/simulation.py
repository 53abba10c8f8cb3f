"""A cloud that fails, under a virtual clock: machines, their bills, and a controller that is killed anywhere.

The journal, the campaign and the collecting of timings are the real ones; only machines, time and the results'
disk are made up. Nothing that a killed controller does afterwards has any effect.
"""

import json
import math
import random
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job, LaunchRefused, Partial, SampleStatus, Unreachable
from fogspec.bench.journal import Journal
from fogspec.plan.commitment import machine_s
from fogspec.plan.schema import Sample
from fogspec.results.requests import RecordRules
from fogspec.results.schema import Measured, Reason, is_final

OWNER = Owner("a repository", "default", "a")
# As in the plan: set-up, measuring.
SETUP_S, AFTER_S = 120.0, 300.0
LISTED_S = 3600.0  # how long a provider that lists machines that have ended does so
GIVEN_UP: tuple[Reason, ...] = ("capacity", "capacity", "quota", "setup", "image")
RULES = RecordRules(warmup=1, valid=0.9, statistic="mean")
NEVER = math.inf


class Killed(BaseException):
    """kill -9: whoever raises this does nothing any more."""


@dataclass
class Machine:
    """A simulated machine and its true bill; times are the world's.

    `fate`: finishes, hangs, crashes, vanishes, writes nonsense; or it is given up before it is ready, for any reason that is
    said of one that was never there. Its own end is armed at `armed`, which may be never, and comes
    `lifetime` and `late` after that; an engine with a time limit ends it at `limit` in any case. From its end, by itself or by
    a request that the cloud accepted at `ended`, it takes `teardown` until it is gone, and is billed until then. Lists show
    it `lag` late, and as long after it is gone.
    """

    sample: str
    price: float
    started: float
    lifetime: float
    fate: str
    ready: float
    done: float
    armed: float = 0.0
    late: float = 0.0
    limit: float = NEVER
    teardown: float = 0.0
    lag: float = 0.0
    ended: float | None = None
    fetched: bool = False

    @property
    def end(self) -> float:
        """When it stops working."""
        own = min(self.armed + self.lifetime + self.late, self.limit + self.late)
        by_itself = min(own, self.done) if self.fate == "vanishes" else own
        return by_itself if self.ended is None else min(by_itself, self.ended)

    @property
    def gone(self) -> float:
        """When it is billed no more."""
        return self.end + self.teardown

    def up(self, now: float) -> bool:
        return now < self.end

    def there(self, now: float) -> bool:
        return now < self.gone

    def listed(self, now: float) -> bool:
        return self.started + self.lag <= now < self.gone + self.lag

    def bill(self, now: float) -> float:
        return self.price * (min(now, self.gone) - self.started) / 3600


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
    wall_error_s: float = 0.0
    absences: list[tuple[float, float]] = field(default_factory=list)
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
        """What the provider charges for everything so far."""
        return sum(machine.bill(self.now) for machine in self.machines.values())

    def absent(self, seconds: float) -> None:
        """No controller looks at anything for so long."""
        self.absences.append((self.now, self.now + seconds))
        self.now += seconds

    def beyond_control(self, machine: Machine, committed_s: float) -> float:
        """What a machine without an end of its own cost beyond its commitment while nobody looked."""
        if min(machine.armed, machine.limit) < NEVER:
            return 0.0
        over = machine.started + committed_s
        away = sum(max(0.0, min(to, machine.gone) - max(since, machine.started)) for since, to in self.absences)
        return machine.price * min(away, max(0.0, min(self.now, machine.gone) - over)) / 3600

    def reboot(self) -> None:
        """The host goes off, and SkyPilot's API server with it: what is not armed then is never armed."""
        self.boot, self.boot_at = self.boot + 1, self.now
        for machine in self.machines.values():
            if machine.armed > self.now:
                machine.armed = NEVER


@dataclass
class VirtualClock:
    """The host's clock; it starts anew with each boot, and a host may be suspended while it waits."""

    world: World
    controller: int

    def now_s(self) -> float:
        return self.world.now - self.world.boot_at

    def boot(self) -> str:
        return f"boot {self.world.boot}"

    def unix_s(self) -> float:
        return 1.7e9 + self.world.now + self.world.wall_error_s

    def sleep(self, seconds: float) -> None:
        self.world.step(self.controller, "sleep")
        self.world.now += seconds
        if self.world.happens(0.002):
            self.world.absent(self.world.chance.uniform(100, 2000))


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
    notes: tuple[str, ...] = ()
    watched: set[str] = field(default_factory=set)
    seen_ready: set[str] = field(default_factory=set)

    def start(self, job: Job) -> None:
        world = self.world
        self._step("before launch")
        if job.name in world.machines:
            world.misdeeds.append(f"{job.name} was started twice")
        if world.happens(0.15):
            reason = world.chance.choice(["capacity", "capacity", "quota"])
            raise LaunchRefused(reason, "no such machine left", again=world.happens(0.4))
        world.machines[job.name] = made(world, job)
        self.watched.add(job.name)
        world.step(self.controller, "after launch")
        if world.happens(0.05):
            raise Unreachable("the answer to the launch was lost")

    def poll(self, job: Job) -> SampleStatus:
        world = self.world
        self._step("poll")
        timings = job.directory / "timings.jsonl"
        machine = world.machines.get(job.name)
        if machine is not None and machine.fetched:
            return self._finished(machine, timings)
        if world.happens(0.1):
            raise Unreachable("no route to host")
        if job.name not in self.watched:
            # Another process started it: the first answer is that of a request on its way.
            self.watched.add(job.name)
            return SampleStatus(running=True, ready=False, measured_on="simulated")
        lied = world.chance.random() if world.faults else 0.5
        if machine is not None and machine.fate in ("no room", "given up"):
            if world.now < machine.ready:
                return SampleStatus(running=True, ready=False)
            reason = world.chance.choice(GIVEN_UP)
            certain = 0.0 if machine.fate == "no room" and world.happens(0.5) else None
            return SampleStatus(running=False, reason=reason, again=world.happens(0.3), billed_s=certain)
        if lied < 0.01 or machine is None or not machine.up(world.now):
            return SampleStatus(running=False, lost=True, detail="the machine is not there")
        if lied > 0.995 and job.name in self.seen_ready:
            return SampleStatus(running=False, reason="capacity", detail="there never was one", billed_s=0.0)
        if world.now < machine.done:
            wrong = 0.01 < lied < 0.03
            ready = (world.now >= machine.ready) is not wrong
            self.seen_ready |= {job.name} if ready else set()
            answered = Partial(1, None) if ready else None
            return SampleStatus(running=True, ready=ready, measured_on="simulated", so_far=answered)
        job.directory.mkdir(parents=True, exist_ok=True)
        write_timings(timings, machine)
        machine.fetched = True
        world.step(self.controller, "fetched")
        return self._finished(machine, timings)

    def _finished(self, machine: Machine, timings: Path) -> SampleStatus:
        reason = "crash" if machine.fate == "crashes" else None
        status = SampleStatus(running=False, timings=timings, reason=reason, measured_on="simulated")
        if machine.fate == "absurd":
            return replace(status, setup_s=1e9, measured_s=1e9, waited_s=0.0)
        return status

    def list(self, owner: Owner, directory: Path) -> list[str]:
        world = self.world
        self._step("list")
        return [name for name, one in world.machines.items() if owner.has(name) and one.listed(world.now)]

    def stop(self, job: Job) -> int | None:
        """The cloud accepts it, takes a while, and says so only then; every second world lists for a while what has ended."""
        world = self.world
        self._step("before end")
        if world.happens(0.1):
            raise Unreachable("no route to host")
        machine = world.machines.get(job.name)
        if machine is not None and machine.ended is None:
            machine.ended = min(world.now, machine.end)
        world.step(self.controller, "after end")
        if machine is not None and machine.there(world.now):
            raise Unreachable("its machine is being taken down")
        if world.happens(0.05):
            raise Unreachable("ended, but nobody said so")
        if world.seed % 4 < 2:
            return None
        return int(machine is not None and machine.gone > machine.started and world.now < machine.gone + LISTED_S)

    def _step(self, what: str) -> None:
        """A call that may take its time."""
        self.world.step(self.controller, what)
        if self.world.happens(0.1):
            self.world.now += self.world.chance.uniform(1, 10)


def made(world: World, job: Job) -> Machine:
    """A machine with a fate: its own end is armed late, may come late or never, and takes a while."""
    chance, now, life = world.chance, world.now, job.lifetime_s
    fate = chance.choices(
        ["finishes", "hangs", "never ready", "crashes", "vanishes", "partial", "absurd", "no room", "given up"],
        [60, 6, 6, 6, 6, 6, 4, 6, 6],
    )[0] if world.faults else "finishes"  # fmt: skip
    boot_s = chance.uniform(60, 300) if world.faults else 0.0
    ready = now + boot_s + chance.uniform(5, 60)
    done = ready + chance.uniform(5, AFTER_S) if fate not in ("hangs", "never ready") else NEVER
    machine = Machine(
        _sample_of(job.name),
        job.machine.price,
        now,
        life,
        fate,
        ready if fate != "never ready" else NEVER,
        done,
        armed=now,
    )
    if not world.faults:
        return machine
    machine.armed, machine.late = now + boot_s, chance.uniform(0, 60)
    machine.teardown, machine.lag = chance.uniform(5, 60), chance.uniform(0, 60)
    kind = chance.random()
    if kind < 0.25:
        machine.limit = now + machine_s(life)
    elif kind < 0.3:
        machine.armed = NEVER
    if fate == "no room":
        # Nothing is up, and nothing is billed.
        machine.ended, machine.teardown = now, 0.0
    return machine


def write_timings(path: Path, machine: Machine) -> None:
    """Ten requests, whose latency tells machines apart; a partial file ends in the middle of a line."""
    latency = machine.started + 1.0
    line = json.dumps({"name": "plan", "start_s": 0, "latency_s": latency, "ok": True, "metrics": {}, "reason": None})
    text = "\n".join([line] * 10) + "\n"
    if machine.fate == "absurd":
        text += "\x00\x07 nonsense\n" + line.replace(str(latency), "-1e999") + "\n"
    path.write_text(text[: len(text) - 25] if machine.fate == "partial" else text)


@dataclass
class SimulatedSink:
    """The results' disk: a write happens whole or not at all."""

    world: World
    controller: int

    def keep(self, record: Measured, timings: Path | None) -> Measured:
        self.world.step(self.controller, "keep timings")
        return record

    def paid(self, sample: Sample, spent_usd: float) -> None:
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
