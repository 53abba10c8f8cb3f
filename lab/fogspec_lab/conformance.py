"""Conformance of an engine: a small application goes all the way on it, through the command line, in a folder of its own.

Bench of two instance types, kill, resume, apply, update, down, nothing left. The most that it can cost is known before anything
starts and is compared with the limit: the bench has a budget, and each of the two machines of the deployment is counted for
`DEPLOYED_S`, after which it is torn down. What happens is a list of steps, and a report without paths, addresses and accounts.
"""

import contextlib
import importlib.metadata
import json
import math
import os
import platform
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import numpy as np

from fogspec import __version__
from fogspec.base import child
from fogspec.base.clouds import LOCAL, cloud_name
from fogspec.base.credentials import FORMS
from fogspec.base.errors import FogspecError, Refused, UsageError
from fogspec.base.project_files import ProjectFiles
from fogspec.base.text import line, markdown, visible
from fogspec.base.units import dollars, format_money, shown_duration
from fogspec.catalog.filters import filter_offers, unknown_places
from fogspec.catalog.machine import Machine
from fogspec.catalog.sources import default_origin, load_catalog
from fogspec.catalog.table import Catalog
from fogspec.compile.inputs import ORIGINS
from fogspec.language.schema import Hardware
from fogspec.plan.commitment import Commitment
from fogspec.results.io import read_results_folder

NAME = "conformance"
MANIFEST = f"compiled/{NAME}/manifest.yaml"
SPEC_FILE = f"specs/{NAME}.yaml"
REQUESTS = 100
DEPLOYED_S = (
    2700.0  # the most that a machine of the deployment is counted for, and allowed: partitions may allow an hour
)
COMMAND_S = 2700.0  # the longest that one command may take
DOWN_S = 600.0  # of a machine's time, kept for tearing it down
OBSERVE_S = 300.0
RELEASE_S, RETRY_S = 180.0, 10.0
OBSERVED = ("Healthy", "Drifted")  # a busy host is no fault of the engine
TIMES = Commitment(measuring_s=60.0, setup_s=600.0)
LEAST_VCPUS, LEAST_GIB = 2.0, 4.0  # of a cloud's machines: SkyPilot's own processes need them
ENDED_S = 120.0
LOCAL_PRICES = """\
Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region
local,1cpu-1gib,1,1,0.01,
local,1cpu-2gib,1,2,0.02,
"""
WORK = """\
import time
import fogspec_probe

while True:
    fogspec_probe.start("work")
    time.sleep(0.03)
    fogspec_probe.stop("work")
"""
# What an issue need not know: accounts, addresses, mailboxes.
PRIVATE = (
    (re.compile("|".join(f"(?:{pattern})" for _, pattern in FORMS)), "CREDENTIAL"),
    (re.compile(r"arn:[\w-]+:\S+"), "ARN"),
    (re.compile(r"\b\d{12}\b"), "ACCOUNT"),
    (re.compile(r"\b(?:\d{1,3}\.){3}\d{1,3}\b"), "ADDRESS"),
    (re.compile(r"[\w.+-]+@[\w-]+(?:\.[\w-]+)+"), "MAILBOX"),
)
STEPS = {
    "plan": "two instance types are planned, within the limit",
    "access": "fogspec bench --dry-run finds no problem",
    "kill": "a bench is killed in the middle (kill -9)",
    "resume": "the bench is resumed, and both types are measured",
    "choose": "a machine is chosen, and its manifest is written",
    "apply": "the manifest is deployed, and its nodes answer",
    "idempotent": "the same apply changes nothing",
    "observe": "status sees requests of the deployment",
    "update": "an update to the other type replaces the machine once the new one answers",
    "down": "everything is torn down, and verified gone",
    "nothing left": "a second look finds nothing",
}


Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Offer:
    """What will be exercised: two instance types of one place, and the most that it can cost."""

    infra: str
    machines: tuple[Machine, Machine]
    catalog: str | None
    max_usd: float

    @property
    def is_local(self) -> bool:
        """Whether the machines are this host, which costs nothing."""
        return self.infra == LOCAL

    @property
    def bench_usd(self) -> float:
        """The most that the bench can cost: each machine until it ends by itself."""
        if self.is_local:
            return 0.0
        # Once more, for what the killed bench had started.
        return 2 * sum(TIMES.usd(one) for one in self.machines)

    @property
    def deployed_usd(self) -> float:
        """The most that the deployment can cost: the machine, and the one that replaces it."""
        return 0.0 if self.is_local else 2 * max(one.paid_usd_per_hour for one in self.machines) * DEPLOYED_S / 3600

    @property
    def worst_usd(self) -> float:
        """The most that all of it can cost."""
        return self.bench_usd + self.deployed_usd

    def price(self, machine: Machine) -> str:
        """Return the price of a machine, for people."""
        return "free" if self.is_local else machine.price_words

    def lines(self) -> list[str]:
        """Return what will be started and what it costs, before anything is."""
        shapes = [f"{one.instance} in {one.infra}, {self.price(one)}" for one in self.machines]
        if self.is_local:
            return [
                f"conformance on {self.infra}: {' and '.join(one.instance for one in self.machines)}; costs nothing"
            ]
        return [
            f"conformance on {self.infra}: {'; '.join(shapes)}",
            f"at most {dollars(self.worst_usd)} of {dollars(self.max_usd)}: bench {dollars(self.bench_usd)}, deployment "
            f"{dollars(self.deployed_usd)}",
        ]

    def check(self) -> None:
        """Raise Refused if it can cost more than its limit."""
        if self.worst_usd > self.max_usd:
            need = math.ceil(self.worst_usd * 100) / 100
            raise Refused(
                f"conformance on {self.infra} can cost {dollars(self.worst_usd)}, more than --max {dollars(self.max_usd)}",
                f"allow it with --max '{format_money(need)}', or name smaller machines with --machines",
            )


def offer(infra: str, wanted: Sequence[str], catalog: str | None, max_usd: float) -> Offer:
    """Return the two instance types to exercise: the wanted ones, else the cheapest two without a GPU.

    Raise UsageError for a place or a machine that the catalog does not have, and the errors of `load_catalog`.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._:@/-]{0,200}", infra):
        hint = "write cloud/region, kubernetes/CONTEXT, slurm/CLUSTER or local"
        raise UsageError(f"--infra {visible(infra)} is not a place", hint)
    if infra == LOCAL:
        if wanted or catalog:
            raise UsageError(
                "--machines and --catalog are for machines of others", "leave them out, or name their --infra"
            )
        small, large = (
            Machine(infra=infra, instance=f"1cpu-{gib}gib", cpus=1.0, memory=float(gib), spot=False, price=0.01 * gib)
            for gib in (1, 2)
        )
        return Offer(infra, (small, large), None, max_usd)
    clouds = [cloud_name(infra)]
    origin = catalog or default_origin(clouds)
    known = load_catalog(origin, clouds)
    for nowhere in unknown_places([infra], known):
        raise UsageError(f"--infra {infra}: {nowhere}", "a list of your own: --catalog FILE (docs/howto/prices.md)")
    offers = filter_offers(known, Hardware(gpus=["none"]), [infra]).offers
    found = _cheapest(offers) if not wanted else [_named(offers, infra, name) for name in wanted]
    if len(found) != 2:
        least = "" if wanted else f" of at least {LEAST_VCPUS:g} vCPUs and {LEAST_GIB:g} GiB, without a GPU, are known"
        hint = "name two with --machines A,B, or a price list with --catalog"
        raise UsageError(f"two instance types are needed, and {len(found)} in {infra}{least}", hint)
    return Offer(infra, (found[0], found[1]), origin, max_usd)


def _cheapest(offers: Catalog) -> list[Machine]:
    """Return the cheapest machine that is large enough, and the cheapest of another shape."""
    found: list[Machine] = []
    for row in np.lexsort((offers.instance, offers.price_usd_per_hour)):
        if offers.vcpus[row] < LEAST_VCPUS or offers.memory_gib[row] < LEAST_GIB:
            continue
        one = offers.machine(int(row))
        if not found or (one.cpus, one.memory) != (found[0].cpus, found[0].memory):
            found.append(one)
        if len(found) == 2:
            break
    return found


def _named(offers: Catalog, infra: str, name: str) -> Machine:
    """Return the cheapest offer of an instance type; raise UsageError if there is none."""
    rows = np.flatnonzero(offers.instance == name)
    if not len(rows):
        raise UsageError(
            f"--machines: {infra} has no {visible(name)}", "write a name of the catalog, as it is spelled there"
        )
    return offers.machine(int(rows[np.argmin(offers.price_usd_per_hour[rows])]))


@dataclass(slots=True)
class Step:
    """One step: ok, failed or not run; what happened, for people; its time in seconds."""

    name: str
    state: str = "not run"
    detail: str = ""
    took_s: float = 0.0


@dataclass(slots=True)
class Outcome:
    """What was exercised, and how it went; `left` is what may still run."""

    infra: str
    machines: list[dict[str, Any]]
    max_usd: float
    worst_usd: float
    versions: dict[str, str]
    began: str
    steps: list[Step] = field(default_factory=lambda: [Step(name) for name in STEPS])
    spent_usd: float = 0.0
    took_s: float = 0.0
    left: bool = False

    @property
    def passed(self) -> bool:
        """Whether every step is ok."""
        return all(one.state == "ok" for one in self.steps)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON has it."""
        return {**asdict(self), "passed": self.passed}

    def as_markdown(self) -> str:
        """Return the report for an issue."""
        said = (
            "passed" if self.passed else "failed: " + ", ".join(one.name for one in self.steps if one.state == "failed")
        )
        shapes = ", ".join(f"{one['instance']} ({one['price']})" for one in self.machines)
        rows = [
            f"| {one.name} | {one.state} | {shown_duration(one.took_s)} | {markdown(one.detail or STEPS[one.name])} |"
            for one in self.steps
        ]
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        return "\n".join([
            f"# Conformance of {markdown(self.infra)}: {said}",
            "",
            f"{markdown(versions)}; {self.began}; {markdown(shapes)}.",
            f"Spent {dollars(self.spent_usd)}, at most {dollars(self.worst_usd)} of a limit of {dollars(self.max_usd)}; "
            f"took {shown_duration(self.took_s)}. "
            + ("Something may still run." if self.left else "Nothing was left."),
            "",
            "| step | outcome | time | |",
            "|--|--|--|--|",
            *rows,
            "",
        ])  # fmt: skip


class Failed(Exception):
    """A step that did not do what it must."""


def write_project(folder: Path, chosen: Offer) -> None:
    """Write the application into an empty folder: its spec, its nodes, and prices of this host."""
    files = ProjectFiles(folder)
    names = [one.instance for one in chosen.machines]
    measured = [f"local/{name}" for name in names] if chosen.is_local else names
    spec: dict[str, Any] = {
        "cloud": [{"cmd": ["python3", "work.py"]}],
        "probe": {"callback": "work"},
        "constraints": {"latency": "10s", "cost": "$1/request"},
        "objective": {"alpha": 0.0},
        "hardware": {"gpus": ["none"], "allow": names},
        "infra": [chosen.infra],
        "deployment": {"until": f"{DEPLOYED_S / 60:g}min"},
        "benchmark": {
            "budget": format_money(max(chosen.bench_usd, 0.01)),
            "machines": measured,
            "ready_timeout": f"{TIMES.setup_s:g}s",
            "warmup": 5,
            "stop": {"requests": REQUESTS, "duration": f"{TIMES.measuring_s:g}s"},
        },
    }
    _write_spec(files, spec)
    files.write(folder / "specs" / "work.py", WORK.encode())
    prices = _prices(folder, chosen.catalog)
    if chosen.catalog is None:
        files.write(Path(prices), LOCAL_PRICES.encode())
    elif os.path.isdir(chosen.catalog):
        shutil.copytree(chosen.catalog, prices)
    elif chosen.catalog not in ORIGINS:
        shutil.copy(chosen.catalog, prices)


def _prices(folder: Path, catalog: str | None) -> str | Path:
    """Return what `compile --catalog` takes in the project: a list of the user's own is copied into it."""
    return catalog if catalog in ORIGINS else folder / "prices.csv"


def _write_spec(files: ProjectFiles, spec: Mapping[str, Any]) -> None:
    document = {"apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": NAME}, "spec": spec}
    # JSON is YAML.
    files.write(Path(files.root) / SPEC_FILE, json.dumps(document, indent=2).encode() + b"\n")


class Exercise:
    """One application on one engine, step by step, each a command as users start it."""

    def __init__(self, chosen: Offer, folder: Path, say: Report) -> None:
        self.offer, self.folder, self.say = chosen, folder, say
        self.outcome = Outcome(
            infra=self.public(chosen.infra),
            machines=[{"instance": one.instance, "price": chosen.price(one)} for one in chosen.machines],
            max_usd=chosen.max_usd,
            worst_usd=chosen.worst_usd,
            versions=versions(chosen.is_local),
            began=datetime.now(UTC).strftime("%Y-%m-%d"),
        )
        self.catalog = ("--catalog", str(_prices(folder, chosen.catalog)))
        self.runner = "local" if chosen.is_local else "skypilot"
        self.started = False
        self.until_s = math.inf

    def run(self) -> Outcome:
        """Take every step until one fails, then tear down what was started; raise KeyboardInterrupt after that."""
        begun_s = time.monotonic()
        write_project(self.folder, self.offer)
        try:
            with contextlib.suppress(Failed):
                self._take()
        finally:
            if self.started:
                self.until_s = math.inf
                with contextlib.suppress(Failed):
                    self._tear_down()
            self.outcome.took_s = time.monotonic() - begun_s
        return self.outcome

    def _take(self) -> None:
        with self._step("plan") as step:
            self._command("compile", SPEC_FILE, *self.catalog)
            step.detail = " and ".join(one.instance for one in self.offer.machines)
        with self._step("access"):
            found = self._command("bench", SPEC_FILE, "--dry-run").splitlines()
            if lost := [line for line in found if line.split()[:3] == ["not", "checked", "access"]]:
                raise Failed(lost[0].strip())
        self.started = True
        with self._step("kill") as step:
            step.detail = self._killed_bench()
        with self._step("resume") as step:
            step.detail = self._resumed_bench()
        with self._step("choose"):
            self._command("compile", SPEC_FILE, *self.catalog)
            if not (self.folder / MANIFEST).is_file():
                raise Failed("compile wrote no manifest")
        # From here on a machine is up that does not end by itself.
        self.until_s = time.monotonic() + DEPLOYED_S - DOWN_S
        with self._step("apply") as step:
            first = self._applied()
            step.detail = f"the nodes answered after {first['waited_s']:.0f} s"
            if not first["changed"]:
                raise Failed("apply says that nothing changed")
        with self._step("idempotent"):
            if self._applied()["changed"]:
                raise Failed("a second apply started something")
        with self._step("observe") as step:
            step.detail = self._observed()
        with self._step("update") as step:
            step.detail = self._updated(first)

    def _tear_down(self) -> None:
        self.outcome.left = True
        with self._step("down") as step:
            ended = self._json("down", NAME)
            self.outcome.spent_usd += 0.0 if self.offer.is_local else float(ended["spent_usd"])
            step.detail = f"{ended['ended']} ended"
        with self._step("nothing left"):
            if again := self._json("down", NAME)["ended"]:
                raise Failed(f"{again} more were found and ended")
        self.outcome.left = False

    def _killed_bench(self) -> str:
        """Kill a bench once a machine is being set up or measures."""
        with open(self.folder / "bench.log", "w+b") as log:
            process = self._start("bench", *self._bench(), "-o", "json", stdout=subprocess.PIPE, stderr=log)
            guard = threading.Timer(COMMAND_S, process.kill)
            guard.start()
            try:
                assert process.stdout is not None
                for line in process.stdout:
                    event = json.loads(line)
                    if event.get("event") in ("sets up", "measures"):
                        return f"while {event['sample']} {event['event']}"
                log.seek(0)
                raise Failed(f"it ended before: {self._reason(log.read().decode('utf-8', 'replace'))}")
            finally:
                guard.cancel()
                process.kill()
                process.wait()

    def _resumed_bench(self) -> str:
        try:
            self._command("bench", *self._bench(), "--resume")
        finally:
            path = self.folder / "results" / NAME
            body = read_results_folder(path).spec if path.is_dir() else None
            self.outcome.spent_usd = 0.0 if body is None or self.offer.is_local else body.spent
        records = {} if body is None else {one.id: one for one in body.samples}
        wrong = [f"{one.id}: {one.state}, {one.detail or one.reason}" for one in records.values() if one.state != "ok"]
        if wrong or len(records) != len(self.offer.machines):
            raise Failed("; ".join(wrong) or f"{len(records)} samples, not {len(self.offer.machines)}")
        means = (one.latency.mean for one in records.values() if one.latency is not None)
        return f"{len(records)} samples of {REQUESTS} requests, mean latency {' and '.join(map(shown_duration, means))}"

    def _bench(self) -> tuple[str, ...]:
        most = format_money(max(self.offer.bench_usd, 0.01))
        return SPEC_FILE, "--runner", self.runner, "--max", most, "--yes"

    def _applied(self) -> dict[str, Any]:
        """Deploy, again while a machine is unavailable: an engine may hold one for a while after it was released."""
        end_s = time.monotonic() + RELEASE_S
        while True:
            try:
                return dict(self._json("apply", MANIFEST, "--yes"))
            except Failed as failed:
                if "safe to run again" not in str(failed) or time.monotonic() > end_s:
                    raise
            time.sleep(RETRY_S)

    def _observed(self) -> str:
        end_s = time.monotonic() + OBSERVE_S
        while True:
            live = self._status()
            seen = live["observed"] or {}
            if live["sync"] == "Synced" and live["health"] in OBSERVED and seen.get("p50_s") is not None:
                return f"median latency {shown_duration(seen['p50_s'])}, {live['health']}"
            if time.monotonic() > end_s:
                raise Failed(f"sync {live['sync']}, health {live['health']}, no request was seen in {OBSERVE_S:g} s")
            time.sleep(2)

    def _status(self) -> dict[str, Any]:
        found = self._json("status", SPEC_FILE)[0]["deployment"]
        if found is None:
            raise Failed("status sees no deployment")
        return dict(found)

    def _updated(self, first: Mapping[str, Any]) -> str:
        spec = self.folder / SPEC_FILE
        document = json.loads(spec.read_bytes())
        # The other type, measured already: a lab may have one machine of each.
        machine = next(one.instance for one in self.offer.machines if one.instance != first["machine"]["instance"])
        document["spec"]["hardware"]["allow"] = [machine]
        document["spec"]["benchmark"]["machines"] = [f"local/{machine}" if self.offer.is_local else machine]
        _write_spec(ProjectFiles(self.folder), document["spec"])
        self._command("compile", SPEC_FILE, *self.catalog)
        second = self._applied()
        if not second["changed"] or second["machine"]["instance"] != machine:
            raise Failed("the machine was not replaced by one of the other type")
        live = self._status()
        if live["sync"] != "Synced":
            raise Failed(f"sync is {live['sync']}")
        return f"{machine} answered after {second['waited_s']:.0f} s"

    @contextmanager
    def _step(self, name: str) -> Iterator[Step]:
        step = next(one for one in self.outcome.steps if one.name == name)
        begun_s = time.monotonic()
        step.state = "failed"
        try:
            yield step
            step.state = "ok"
        except KeyboardInterrupt:
            step.detail = "interrupted"
            raise
        except (Failed, OSError, KeyError, TypeError, ValueError, FogspecError) as wrong:
            why = wrong.message if isinstance(wrong, FogspecError) else str(wrong)
            step.detail = self.public(why or type(wrong).__name__)
            raise Failed(step.detail) from None
        finally:
            step.took_s = time.monotonic() - begun_s
            self.say(f"{step.name}: {step.state}" + (f", {step.detail}" if step.detail else ""))

    def _json(self, *words: str) -> Any:
        return json.loads(self._command(*words, "-o", "json"))

    def _command(self, *words: str) -> str:
        """Run a command to its end and return what it printed; raise Failed with its reason."""
        limit_s = min(COMMAND_S, self.until_s - time.monotonic())
        process = self._start(*words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        try:
            out, err = process.communicate(timeout=max(limit_s, 1.0))
        except (subprocess.TimeoutExpired, KeyboardInterrupt) as why:
            # As Ctrl-C does: it ends what it was starting.
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=ENDED_S)
            process.kill()
            process.communicate()
            if isinstance(why, KeyboardInterrupt):
                raise
            raise Failed(f"fogspec {words[0]} took longer than {limit_s:.0f} s") from None
        if process.returncode:
            text = err.decode("utf-8", "replace") + (out.decode("utf-8", "replace") if "--dry-run" in words else "")
            raise Failed(f"fogspec {words[0]} ended with {process.returncode}: {self._reason(text)}")
        return out.decode("utf-8", "replace")

    def _start(self, *words: str, stdout: int, stderr: "int | IO[bytes]") -> "subprocess.Popen[bytes]":
        return subprocess.Popen(
            [*child.python("fogspec"), *words],
            cwd=self.folder,
            env=child.environment(),
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
        )

    def _reason(self, text: str) -> str:
        """Return the error that a command printed, with what it says under it; else its last line."""
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        at = next((i for i, line in enumerate(lines) if line.startswith("error") or "problem" in line), len(lines) - 1)
        return " / ".join(lines[max(at, 0) : at + 4])[:1000] or "it printed nothing"

    def public(self, text: str) -> str:
        """Return a text without this computer's paths and names, accounts, addresses and credentials."""
        for value, name in ((str(self.folder), "PROJECT"), (str(Path.home()), "~"), (os.uname().nodename, "HOST")):
            text = re.sub(rf"(?<!\w){re.escape(value)}(?!\w)", name, text)
        for pattern, name in PRIVATE:
            text = pattern.sub(name, text)
        return line(text)


def versions(is_local: bool) -> dict[str, str]:
    """Return the versions of what was exercised."""
    system = f"{platform.system()} {platform.machine()}"
    found = {"fogspec": __version__, "Python": platform.python_version(), "on": system}
    if not is_local:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found["SkyPilot"] = importlib.metadata.version("skypilot")
    return found
