"""Faults at AWS's API, by the hundred: `make aws-faults` prints what leaked, was lost or cost too much, by EC2's own account.

A life is a seed: one bench to its end, however often it is broken off, with faults that its calls and machines meet, and its
processes killed meanwhile. Lives share one account and one API server, so that expired credentials and a killed server are
everybody's. `[FAULTS [SEED [MINUTES [AT_ONCE]]]]`; a fault counts once, and only if it was met.
"""

import collections
import contextlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogspec.bench.journal import Journal
from fogspec.results.io import read_results_folder
from fogspec.results.schema import is_final
from tests.aws.site import AwsSite
from tests.slurm import breaking
from tests.tools import apart
from tests.tools.aws import engine

MACHINES = ("c6i.large", "m6i.large", "c6i.xlarge")
BUDGET_USD = 0.8
ROUNDS, ROUND_S = 12, 2400.0
ENDED = (0, 1)  # the exit codes of a bench that was not broken off
USER = "AKIAOFTHEUSER"

# What AWS answers: docs.aws.amazon.com/AWSEC2/latest/APIReference/errors-overview.html
ANSWERS = {
    "InsufficientInstanceCapacity": "We currently do not have sufficient capacity in the Availability Zone you requested.",
    "VcpuLimitExceeded": "You have requested more vCPU capacity than your current vCPU limit of 0 allows.",
    "RequestLimitExceeded": "Request limit exceeded.",
    "InternalError": "An internal error has occurred.",
    "InvalidInstanceID.NotFound": "The instance ID does not exist",
    "ExpiredToken": "The security token included in the request is expired",
}


@dataclass(frozen=True)
class Kind:
    """A kind of fault at the API or of a machine: what is posted, with ranges drawn from, and how often it is drawn."""

    name: str
    posted: dict[str, Any]
    share: int = 1
    everybodys: bool = False


def api(action: str, code: str, times: tuple[int, int] = (1, 3), skip: tuple[int, int] = (0, 0)) -> dict[str, Any]:
    """A call that is refused."""
    return {"action": action, "code": code, "message": ANSWERS[code], "times": times, "skip": skip}


KINDS = (
    Kind("no capacity (InsufficientInstanceCapacity)", api("RunInstances", "InsufficientInstanceCapacity", (1, 6)), 2),
    Kind("launch throttled (RequestLimitExceeded)", api("RunInstances", "RequestLimitExceeded"), 2),
    Kind("lists throttled (RequestLimitExceeded)", api("DescribeInstances", "RequestLimitExceeded", (1, 4), (0, 6)), 2),
    Kind("end throttled (RequestLimitExceeded)", api("TerminateInstances", "RequestLimitExceeded", (1, 3)), 2),
    Kind("end refused twice (InternalError)", api("TerminateInstances", "InternalError", (2, 2)), 2),
    Kind("new instance not found (InvalidInstanceID.NotFound)", api("CreateTags", "InvalidInstanceID.NotFound", (1, 1)), 1),
    Kind("new instance not listed yet", {"action": "vanish", "how": "invisible", "after_s": (3, 25)}, 2),
    Kind("launch hangs", {"action": "RunInstances", "hang_s": (5, 70)}, 1),
    Kind("launch done, its answer hangs", {"action": "RunInstances", "hang_s": (5, 70), "how": "answer"}, 1),
    Kind("list hangs", {"action": "DescribeInstances", "hang_s": (5, 70), "skip": (0, 6)}, 1),
    Kind("end hangs", {"action": "TerminateInstances", "hang_s": (5, 70)}, 1),
    Kind("machine dies in set-up", {"action": "boot", "how": "dying", "after_s": (3, 60)}, 1),
    Kind("machine never answers SSH", {"action": "boot", "how": "silent"}, 0),
    Kind("machine reclaimed after its notice", {"action": "reclaim", "how": "reclaim", "after_s": (1, 120)}, 1),
    Kind("no quota (VcpuLimitExceeded)", api("RunInstances", "VcpuLimitExceeded", (1, 2)), 0),
    Kind("credentials expired (ExpiredToken)", {"action": "*", "code": "ExpiredToken", "message": ANSWERS["ExpiredToken"],
                                                "for_s": (5, 45), "skip": (0, 150)}, 1, everybodys=True),
)  # fmt: skip
KILLS = ("kill -9 of fogspec bench", "kill -9 of its worker", "kill -9 of the API server", "Ctrl-C")
MOMENTS = ("starts", "sets up", "measures", "ends", "is done")


@dataclass(frozen=True)
class Kill:
    """A process is ended so long after something was said the first time, or after the bench began."""

    name: str
    after: str
    delay_s: float


@dataclass
class Life:
    """One bench to its end; `struck` is what it met."""

    seed: int
    site: AwsSite
    server: threading.Lock
    struck: collections.Counter[str] = field(default_factory=collections.Counter)
    controllers: int = 0
    log: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.name, self.chance = f"life-{self.seed}", random.Random(f"aws {self.seed}")
        self.events = self.site.project / "events.jsonl"

    def run(self) -> None:
        """Measure with faults until nothing is left to measure."""
        spec = self.site.write(self.name, list(MACHINES), steps=40)
        self.site.edit(spec, "budget: $10", f"budget: ${BUDGET_USD}")
        self.site.edit(spec, "ready_timeout: 20min", "ready_timeout: 10min")
        self.site.prefix = self.site.machine(self.name)
        self.site.compile(spec)
        kills = self.drawn()
        begun = time.monotonic()
        while self.controllers < ROUNDS:
            self.controllers += 1
            code = self.bench(spec, kills, begun)
            self.log.append(str(code))
            if code in ENDED and not self.left():
                break
            time.sleep(5)  # so does its user, who logs in again meanwhile
        else:
            raise AssertionError(f"it is never done: {self.site.project}")
        for one in engine.ask("/_lift", whose=self.name):
            self.struck[one["name"]] += one["met"] > 0

    def left(self) -> list[str]:
        """Samples that the next bench measures: those that failed for a reason that passes."""
        results = read_results_folder(self.site.project / "results" / self.name).spec
        return [one.id for one in results.samples if not is_final(one)]

    def drawn(self) -> list[Kill]:
        """Post what its calls and machines meet; return what happens to its processes."""
        chance = self.chance
        for machine in MACHINES:
            kinds = chance.choices(KINDS, [one.share for one in KINDS], k=chance.randint(3, 6))
            for kind in {one.name: one for one in kinds}.values():
                match = USER if kind.everybodys else self.site.machine(self.name, machine)
                self.post(kind, match)
        if self.seed % 6 == 0:
            rare = next(one for one in KINDS if not one.share and (self.seed // 6 + ("SSH" in one.name)) % 2)
            self.post(rare, self.site.machine(self.name, chance.choice(MACHINES)))
        names = chance.choices(KILLS, (3, 3, 1, 2), k=chance.randint(2, 4))
        return [Kill(name, chance.choice(MOMENTS), chance.uniform(0, 25)) for name in names]

    def post(self, kind: Kind, match: str) -> None:
        """Let a fault wait for what it is for."""
        drawn = {
            key: self.chance.randint(*value) if isinstance(value, tuple) else value
            for key, value in kind.posted.items()
        }
        engine.ask("/_fault", match=match, name=kind.name, whose=self.name, **drawn)

    def bench(self, spec: str, kills: list[Kill], begun: float) -> int:
        """One controller; its exit code."""
        before = self.events.stat().st_size if self.events.exists() else 0
        bench = self.site.bench(spec, "--resume", log=self.events)
        since, end = dict[str, float](), time.monotonic() + ROUND_S
        while bench.process.poll() is None:
            said = self.events.read_bytes()[before:]
            for moment in MOMENTS:
                if f'"{moment}"'.encode() in said:
                    since.setdefault(moment, time.monotonic())
            for kill in list(kills):
                if time.monotonic() >= since.get(kill.after, end) + kill.delay_s:
                    kills.remove(kill)
                    self.strike(kill.name, bench.process)
            if time.monotonic() > end:
                bench.process.kill()
                raise AssertionError(f"it does not end: {self.site.project}")
            time.sleep(0.5)
        return int(bench.process.returncode)

    def strike(self, name: str, process: Any) -> None:
        """End a process; it counts where there was one."""
        if name == "kill -9 of fogspec bench":
            breaking.kill(process.pid)
            done = process.wait() == -signal.SIGKILL
        elif name == "kill -9 of its worker":
            done = breaking.kill_below(process.pid) > 0
        elif name == "Ctrl-C":
            breaking.kill(process.pid, signal.SIGINT)
            done = True
        else:
            with self.server:
                done = breaking.end_server(self.site.cluster)
        self.struck[name] += done


@dataclass
class Judged:
    """What must never happen, and what became of the samples."""

    never: collections.Counter[str] = field(default_factory=collections.Counter)
    samples: collections.Counter[str] = field(default_factory=collections.Counter)
    billed_usd: float = 0.0
    booked_usd: float = 0.0


def judge(life: Life) -> Judged:
    """EC2's word against fogspec's."""
    site, found = life.site, Judged()
    found.never["machines leaked"] += len(site.left(120.0))
    results = read_results_folder(site.project / "results" / life.name).spec
    journal = site.project / ".fogspec" / life.name / "journal.jsonl"
    book = Journal(journal).state
    found.billed_usd, found.booked_usd = site.bill(), max(results.spent, book.spent_usd)
    found.never["budgets exceeded"] += max(found.billed_usd, found.booked_usd) > BUDGET_USD
    found.never["bills above what was booked"] += found.billed_usd > found.booked_usd * 1.02 + 1e-4
    found.never["machines not accounted for"] += len(book.open)
    found.never["samples lost"] += len(MACHINES) - len({one.machine.instance for one in results.samples})
    found.never["samples lost"] += sum(not is_final(one) for one in results.samples)
    entries = [json.loads(line) for line in journal.read_text().splitlines()]
    ended = [entry["record"] for entry in entries if entry["do"] == "end" and entry["record"] is not None]
    counts = collections.Counter(one["id"] for one in ended if one["state"] != "failed")
    found.never["measured twice"] += sum(count > 1 for count in counts.values())
    found.samples.update(one.state if one.reason is None else one.reason for one in results.samples)
    return found


def lived(seed: int, scratch: Path, server: threading.Lock, tell: Callable[[str], None]) -> tuple[Life, Judged]:
    """A life, whatever becomes of it."""
    life = Life(seed, AwsSite(Path(os.environ[apart.FOLDER]), scratch / f"life-{seed}" / "project"), server)
    found, begun = Judged(), time.monotonic()
    try:
        life.run()
        found = judge(life)
    except Exception as problem:
        found.never[f"life {seed}: {type(problem).__name__}: {problem}"] += 1
    wrong = +found.never
    tell(
        f"life {seed}, {time.monotonic() - begun:.0f} s, exit codes {' '.join(life.log)}: "
        f"{', '.join(f'{count} {name}' for name, count in (+life.struck).items())}; samples {dict(found.samples)}; EC2 bills "
        f"${found.billed_usd:.4f}, booked ${found.booked_usd:.4f}; {dict(wrong) or 'nothing wrong'}"
    )
    if not wrong:
        shutil.rmtree(life.site.project.parent)
    return life, found


def ready(folder: Path, attempts: int = 10) -> None:
    """Let the API server start, for which SkyPilot waits a minute only, however busy this machine is."""
    for _ in range(attempts):
        with contextlib.suppress(IndexError, ValueError, OSError):
            engine.clusters(folder)
            return
    raise RuntimeError("SkyPilot's API server does not start")


def main(words: Sequence[str]) -> int:
    """Lives until enough faults were met or the time is over; exit code 1 if something happened that never must."""
    defaults = ("200", "0", "600", "3")
    wanted, first, minutes, at_once = (int(word) for word in [*words, *defaults[len(words) :]])
    scratch, server, lock = Path(tempfile.mkdtemp(prefix="fogspec-aws-faults-")), threading.Lock(), threading.Lock()
    struck, begun = collections.Counter[str](), time.monotonic()
    seeds, done = iter(range(first, 10**6)), list[tuple[Life, Judged]]()

    def tell(said: str) -> None:
        print(said, flush=True)

    ready(Path(os.environ[apart.FOLDER]))

    def lives() -> None:
        while time.monotonic() - begun < 60 * minutes:
            with lock:
                if struck.total() >= wanted:
                    return
                seed = next(seeds)
            life, found = lived(seed, scratch, server, tell)
            with lock:
                struck.update(life.struck)
                done.append((life, found))

    with ThreadPoolExecutor(at_once) as pool:
        for one in [pool.submit(lives) for _ in range(at_once)]:
            one.result()
    never = sum((found.never for _, found in done), collections.Counter[str]())
    samples = sum((found.samples for _, found in done), collections.Counter[str]())
    tell(table(struck))
    tell(
        f"{len(done)} benches from seed {first}, {sum(life.controllers for life, _ in done)} controllers, "
        f"{struck.total()} faults, in {time.monotonic() - begun:.0f} s; samples: {dict(samples)}; EC2 bills "
        f"${sum(found.billed_usd for _, found in done):.4f}, booked ${sum(found.booked_usd for _, found in done):.4f}"
    )
    tell(", ".join(f"{name} {count}" for name, count in never.items()))
    with contextlib.suppress(OSError):
        scratch.rmdir()
    return min(1, never.total())


def table(struck: collections.Counter[str]) -> str:
    """What was met how often, for docs/reference/support.md."""
    names = [*(one.name for one in KINDS), *KILLS]
    return "\n".join(["| fault | met |", "|--|--|", *(f"| {name} | {struck[name]} |" for name in names)])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
