"""Deployments on the real engine, each with faults: `make slurm-lives` prints what `down` left.

A life is a seed: a manifest from recorded results is applied, what broke or not is gone on with as a user would, then `down`
has to leave nothing. Lives run beside each other, a lane of nodes each, with one API server and one clock.
"""

import collections
import contextlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.slurm import breaking, leftovers, robot
from tests.slurm.clock import Clock
from tests.slurm.fates import FAULTS, LANES, OF_A_COMMAND, Fault, drawn
from tests.slurm.site import Site, recorded
from tests.tools import apart
from tests.tools.slurm.shapes import SHAPES

COMMAND_S = 600.0
DISK = "2m"
DAY_S = 86400
DOWNS = 5
AT_ONCE = 2
BUG = 70
LINKED = 1  # the lane whose applications have a robot and a link


@dataclass
class Life:
    """One application, from its first apply to nothing left."""

    seed: int
    site: Site
    clock: Clock
    seen: set[str]
    struck: list[str] = field(default_factory=list)
    did: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    left: collections.Counter[str] = field(default_factory=collections.Counter)

    def __post_init__(self) -> None:
        self.name, self.lane = f"life-{self.seed}", LANES[self.seed % len(LANES)]
        self.chance = random.Random(f"life {self.seed}")
        self.project, self.folder = self.site.project, self.site.project.parent.parent
        self.log, self.ballast = self.folder / "said.log", self.project.parent / "ballast"
        self.manifest = f"compiled/{self.name}/manifest.yaml"

    def run(self) -> None:
        """Apply, whatever a user does next, down."""
        self.begin()
        faults = drawn(self.seed, self.chance)
        if self.command("apply", self.manifest, "--yes", faults=faults["apply"]) == 0:
            self.look()
        for act in self.chance.choices(("apply", "status", "diff"), k=self.chance.randint(0, 2)):
            words = (self.manifest, "--yes") if act == "apply" else (self.spec,)
            self.command(act, *words)
        if faults["change"] or self.chance.random() < 0.3:
            path = self.project / self.spec
            path.write_text(path.read_text().replace("alpha: 0", "alpha: 1"))
            self.command("compile", self.spec, *self.site.at)
            self.command("apply", self.manifest, "--yes", faults=faults["change"])
        self.end(faults["down"])

    def begin(self) -> None:
        """A project on a small disk of its own, with a manifest."""
        self.project.parent.mkdir(parents=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "fogspec-life", self.project.parent], check=True)
        self.spec = self.site.write(self.name, list(self.lane.machines))
        path = self.project / self.spec
        text = re.sub(
            "hardware: .*", f"hardware: {{{self.lane.hardware}, memory_per_cpu: 1GiB..16GiB}}", path.read_text()
        )
        text = text.replace("alpha: 0.5", "alpha: 0").replace(
            "  benchmark:", "  deployment: {ready_timeout: 5min}\n  benchmark:"
        )
        path.write_text(text)
        linked = self.seed % len(LANES) == LINKED
        if linked:
            robot.write(self.site, self.spec, tells="")
        self.site.compile(self.spec)
        recorded(self.site, self.name)
        self.site.compile(self.spec)
        if linked:
            self.site.keys(self.name)
        self.expected, self.keys = leftovers.tree(self.project), leftovers.tree(self.site.links(self.name))

    def command(self, *words: str, folder: Path | None = None, faults: Sequence[Fault] = ()) -> int:
        """Run fogspec and break things meanwhile; its exit code. What happens only to a command may come too late."""
        self.did.append(words[0])
        environment = self.site._env() | {leftovers.MARK: self.name}
        begun, known = (
            self.log.stat().st_size if self.log.exists() else 0,
            set(leftovers.folders(self.site.cluster, self.name)),
        )
        with open(self.log, "ab") as log:
            process = subprocess.Popen(self.site._argv(words), cwd=folder or self.project, env=environment, stdout=log,
                                       stderr=log, stdin=subprocess.DEVNULL, start_new_session=True)  # fmt: skip
        waiting, since, end = list(faults), dict[str, float](), time.monotonic() + COMMAND_S
        while process.poll() is None:
            for fault in list(waiting):
                if fault.after not in since and self.reached(fault.after, self.said(begun), known):
                    since[fault.after] = time.monotonic()
                if time.monotonic() >= since.get(fault.after, end) + fault.delay_s:
                    waiting.remove(fault)
                    self.strike(fault.name, process)
            if time.monotonic() > end:
                self.wrong.append(f"{words[0]} does not end")
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(0.1)
        for fault in waiting:
            if fault.name not in OF_A_COMMAND:
                self.strike(fault.name, process)
        self.did[-1] += f" {process.returncode}"
        if re.search("^Traceback", self.said(begun), re.MULTILINE) or process.returncode == BUG:
            self.wrong.append(f"{words[0]}: a bug")
        return process.returncode

    def said(self, begun: int) -> str:
        """What the commands said after this many bytes."""
        return self.log.read_bytes()[begun:].decode("utf-8", "replace")

    def reached(self, what: str, said: str, known: set[Path]) -> bool:
        """Whether the command has come so far."""
        if what == "up":
            return bool(set(leftovers.folders(self.site.cluster, self.name)) - known)
        if what == "ending":
            with contextlib.suppress(OSError):
                return "state: ending" in (self.project / ".fogspec" / self.name / "deployment.yaml").read_text()
            return False
        return {"begun": "", "priced": "/month", "starting": ": starting fogspec-"}[what] in said

    def strike(self, fault: str, process: "subprocess.Popen[bytes]") -> None:
        """Break something; it counts where there was something to break."""
        cluster, done = self.site.cluster, True
        if "commands" not in self.seen and leftovers.now(self.site, self.name)["commands"]:
            self.seen.add("commands")
        if fault in ("kill", "interrupt", "insist"):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL if fault == "kill" else signal.SIGINT)
                if fault == "insist":
                    time.sleep(self.chance.uniform(0.2, 3))
                    os.killpg(process.pid, signal.SIGINT)
            done = fault != "kill" or process.wait() == -signal.SIGKILL
        elif fault == "worker":
            done = breaking.kill_below(process.pid) > 0
        elif fault in ("server", "lone server"):
            done = breaking.end_server(cluster, self.chance.uniform(2, 15) if fault == "lone server" else 0.0)
        elif fault == "machine":
            done = bool(leftovers.now(self.site, self.name)["jobs"])
            self.site.cancel(f"fogspec-{self.name}-")
        elif fault == "node":
            breaking.node_down(cluster, next(one.name for one in SHAPES if one.instance == self.lane.machines[0]))
        elif fault == "network":
            breaking.unplug(cluster)
        elif fault == "disk":
            self.fill()
        else:
            self.clock.set(self.chance.choice((-400, -1, 1, 400)) * DAY_S + self.chance.randrange(DAY_S))
        if done:
            self.struck.append(fault)

    def fill(self) -> None:
        """The disk of the project is full, until somebody makes room."""
        with contextlib.suppress(OSError), open(self.ballast, "ab", buffering=0) as file:
            while True:
                file.write(bytes(4096))

    def look(self) -> None:
        """What is there must be seen, or else a judgement that finds nothing would be worth nothing."""
        if not self.seen >= {*leftovers.KINDS} - {"commands"}:
            found = self.found(leftovers.now(self.site, self.name), self.project, self.expected)
            self.seen.update(kind for kind, those in found.items() if those)

    def end(self, faults: Sequence[Fault]) -> None:
        """`down` here, after the live state was lost, or where it never was."""
        where = self.chance.choice(("here", "here", "elsewhere", "lost"))
        self.did.append(where)
        if where == "lost":
            shutil.rmtree(self.project / ".fogspec", ignore_errors=True)
        if where == "elsewhere":
            other = self.folder / "elsewhere"
            for one in ("specs", "compiled"):
                shutil.copytree(self.project / one, other / one)
            expected = leftovers.tree(other)
            self.down(other, faults)
            self.judge(other, expected)
            faults = ()
        self.down(self.project, faults)
        self.judge(self.project, self.expected)

    def down(self, folder: Path, faults: Sequence[Fault]) -> None:
        """As often as it takes: what it says, and a user does."""
        if not self.struck and not faults:
            faults = [Fault("kill", "begun", self.chance.uniform(0.5, 5))]
        for number in range(DOWNS):
            if self.command("down", self.name, folder=folder, faults=() if number else faults) == 0:
                return
            self.ballast.unlink(missing_ok=True)
        self.wrong.append("down never said that nothing is left")

    def judge(self, root: Path, expected: set[str]) -> None:
        """What is left though nothing should be."""
        found = self.found(leftovers.settled(self.site, self.name), root, expected)
        for kind, those in found.items():
            self.left[kind] += len(those)
            self.wrong += [f"{kind}: {one}" for one in those if kind in leftovers.KINDS]

    def found(self, running: dict[str, list[str]], root: Path, expected: set[str]) -> dict[str, list[str]]:
        """What runs, with SkyPilot's records, files, and keys of the link: only the robot's own may stay."""
        keys = running["keys"] + leftovers.files(self.site.links(self.name), self.keys)
        clusters, files = leftovers.clusters(self.site, self.name), leftovers.files(root, expected)
        return {**running, "clusters": clusters, "files": files, "keys": keys}

    def close(self) -> None:
        """Its disk goes; the files of a life that went wrong are kept, and what every one has said."""
        if self.wrong:
            shutil.copytree(self.project, self.folder / "project", ignore_dangling_symlinks=True)
        subprocess.run(["umount", "--lazy", self.project.parent], check=False)
        shutil.rmtree(self.folder / "elsewhere", ignore_errors=True)


def lived(seed: int, cluster: Path, scratch: Path, clock: Clock, seen: set[str]) -> Life:
    """A life, whatever becomes of it."""
    life = Life(seed, Site(cluster, scratch / f"life-{seed}" / "disk" / "project"), clock, seen)
    begun = time.monotonic()
    try:
        life.run()
    except Exception as problem:
        life.wrong.append(f"{type(problem).__name__}: {problem}")
    finally:
        life.close()
        if "clock" in life.struck:  # with a wrong one no link comes up, and each apply would wait for it
            clock.set(0)
    said = f"; wrong: {life.wrong}, see {life.folder}" if life.wrong else "; nothing left"
    print(
        f"life {seed}, {time.monotonic() - begun:.0f} s: {', '.join(life.struck)}: {', '.join(life.did)}{said}",
        flush=True,
    )
    return life


def one_by_one(seeds: Sequence[int], end: float, *where: Any) -> list[Life]:
    """One after the other, as long as there is time."""
    return [lived(one, *where) for one in seeds if time.monotonic() < end]


def main(words: Sequence[str]) -> int:
    """Lives of `[RUNS [SEED [MINUTES]]]`; exit code 1 when anything was left, or when nothing could have been seen."""
    wanted, first, minutes = (int(word) for word in [*words, *("50", "0", "600")[len(words) :]])
    cluster, scratch = Path(os.environ[apart.FOLDER]), Path(tempfile.mkdtemp(prefix="fogspec-lives-"))
    clock, seen, begun = Clock.made(scratch), set[str](), time.monotonic()
    os.environ.update(clock.environment)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        # No two of the seeds that go on at the same time are of the same lane.
        parts = [range(first + number, first + wanted, AT_ONCE) for number in range(AT_ONCE)]
        each = [pool.submit(one_by_one, part, begun + 60 * minutes, cluster, scratch, clock, seen) for part in parts]
        lives = [life for part in each for life in part.result()]
    late = Site(cluster, scratch).left()
    unseen = {*leftovers.KINDS} - seen
    print(f"{len(lives)} of {wanted} lives from seed {first}, in {time.monotonic() - begun:.0f} s; {summary(lives)}")
    print(f"on the cluster in the end: {late or 'nothing'}; never seen, so not judged: {sorted(unseen) or 'nothing'}")
    return 1 if late or unseen or any(life.wrong for life in lives) else 0


def summary(lives: Sequence[Life]) -> str:
    """What was broken, and what was left."""
    struck = collections.Counter(fault for life in lives for fault in life.struck)
    left = sum((life.left for life in lives), collections.Counter[str]())
    faults = ", ".join(f"{count} {FAULTS[name]}" for name, count in struck.most_common())
    kinds = ", ".join(f"{left[kind]} {kind}" for kind in (*leftovers.KINDS, leftovers.SKYPILOTS))
    broken, wrong = sum(bool(life.struck) for life in lives), sum(bool(life.wrong) for life in lives)
    return f"{broken} with faults: {faults}; left after down: {kinds}; {wrong} lives went wrong"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
