"""Run the cloud nodes of a deployment: start them, report when they are ready, and end all when one ends.

    python3 agent.pyz supervisor --out DIR [--ready '<json argv>'] [--secret NAME ...]
                                 [--lifetime SECONDS] [--ends UNIX] --process '<json>' [--process ...]
                                 [--listener '<json argv>' ...] [--asks '<json argv>']

A process is an argv, or a mapping `{"argv": [...], "name": ..., "respawn": "always"|"on_failure", "respawn_delay": s}`: with a
name each line that it prints begins with `[name] `; with `respawn` it is started again when it ends, or when it fails. Each
further restart in a row waits twice as long, at most `LONGEST_DELAY_S`; a process that stayed up for `STEADY_S` starts from the
first delay. After `MOST_RESTARTS` in a row its end is the end of all.
With a lifetime all end after it, or at `--ends` if that comes first.

DIR/state.json has the state (starting, ready, ended), detail, ready_s, observed, restarts by name, facts of the server, and
the public half of the link from DIR/link.pub. Probes append one line of JSON per request to FOGSPEC_TIMINGS
(DIR/timings.jsonl), which is moved to timings.1.jsonl when it is large, so that both together stay bounded. A listener only
observes: its end does not end the nodes. Nor do parameters that a node lacks, which `--asks` finds: they are a detail. The
output of all is passed on without the values of secret variables. For controllers that cannot read files on this machine, the
log regularly contains the same state with the latest requests:

    === fogspec state {"state": "ready", ..., "latest": [[name, latency_s, ok, scenario, end_s], ...],
                       "open": [[name, start_s], ...]} ===
"""

import argparse
import contextlib
import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from . import machine_facts, packages, processes, redaction
from .declared import REFUSED
from .files import read_tail, write_new
from .sample import extract, last_line
from .shared_memory import SharedMemory

POLL_S = 0.1
ALIVE_S = 2.0
CHECK_EVERY_S = 1.0
CHECK_TIMEOUT_S = 30.0
TIMINGS_LIMIT = 4 * 2**20
LOG_LIMIT = 64 * 2**20
REPORT_FIRST_S, REPORT_EVERY_S = 10.0, 120.0
LATEST, OPEN = 100, 20
PACKAGES_LIMIT, PACKAGES_EVERY = 2**17, 10  # bytes; reports in the log, which are read by hundreds
FIRST_DELAY_S, LONGEST_DELAY_S = 1.0, 60.0
STEADY_S = 60.0
MOST_RESTARTS = 5
POLICIES = ("always", "on_failure")
WRONG_CLOCK_S = 3600.0
OVER = "spec.deployment.until or budget is reached"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the processes until one ends (return 1), or a signal or the lifetime requests the end (return 0)."""
    options = parse(arguments)
    signals = processes.received_signals()
    processes.adopt_orphans()
    supervisor = Supervisor(options)
    try:
        supervisor.start()
        detail = supervisor.watch(signals)
    except OSError as problem:
        detail = f"cannot be started: {problem}"
    finally:
        supervisor.finish()
        supervisor.output.settle()
    supervisor.report("ended", detail)
    return 0 if signals or supervisor.is_over() else 1


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; exit with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="supervisor", allow_abbrev=False)
    parser.add_argument("--out", required=True)
    parser.add_argument("--ready", type=json.loads)
    parser.add_argument("--secret", action="append", default=[])
    parser.add_argument("--lifetime", type=float)
    parser.add_argument("--ends", type=float)
    parser.add_argument("--process", type=json.loads, action="append", required=True)
    parser.add_argument("--listener", type=json.loads, action="append", default=[])
    parser.add_argument("--asks", type=json.loads)
    options = parser.parse_args(arguments)
    try:
        options.process = [Kept.of(value) for value in options.process]
    except ValueError as wrong:
        parser.error(str(wrong))
    for one, name in zip(options.process, processes.told_apart(one.name for one in options.process), strict=True):
        one.name = name
    for argv in (*options.listener, *(one for one in (options.ready, options.asks) if one)):
        if not processes.is_argv(argv):
            parser.error("a command must be a JSON list of strings")
    return options


@dataclass
class Kept:
    """A process that is kept running: its restart policy, and how often it was started again."""

    argv: list[str]
    name: str
    respawn: str | None = None
    delay_s: float = FIRST_DELAY_S
    process: "subprocess.Popen[bytes] | None" = None
    started_s: float = 0.0
    due_s: float | None = None
    in_a_row: int = 0
    restarts: int = 0
    marked: bool = False

    @staticmethod
    def of(value: Any) -> "Kept":
        """Return the process that a JSON value describes; raise ValueError for anything else."""
        if processes.is_argv(value):
            return Kept(value, processes.program(value))
        wrong = "a process must be a JSON list of strings, or a mapping with argv, name, respawn and respawn_delay"
        if not isinstance(value, dict) or not processes.is_argv(value.get("argv")):
            raise ValueError(wrong)
        delay_s = value.get("respawn_delay", FIRST_DELAY_S)
        name = value.get("name", os.path.basename(value["argv"][0]))
        respawn = value.get("respawn")
        if respawn not in (None, *POLICIES) or not isinstance(delay_s, (int, float)) or not isinstance(name, str):
            raise ValueError(wrong)
        name = "".join(c for c in name if c.isprintable())
        return Kept(value["argv"], name, respawn, max(0.0, float(delay_s)), marked=True)

    def ended(self, code: int, now_s: float) -> str | None:
        """Take its end: return why that ends the deployment, or None if the process is to be started again at `due_s`."""
        if now_s - self.started_s >= STEADY_S:
            self.in_a_row = 0
        how = f"{self.name} {processes.exit_text(code)}"
        if self.respawn is None or (self.respawn == "on_failure" and code == 0):
            return how
        if self.in_a_row >= MOST_RESTARTS:
            return f"{how}, after {MOST_RESTARTS} restarts in a row"
        self.due_s = now_s + min(self.delay_s * 2**self.in_a_row, LONGEST_DELAY_S)
        self.in_a_row += 1
        return None


class Supervisor:
    """The processes of one deployment, from their start to their end."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, Path(options.out).absolute()
        self.timings = self.out / "timings.jsonl"
        self.output = redaction.Output(options.secret)
        self.shared_memory = SharedMemory()
        self.kept: list[Kept] = options.process
        self.ends = processes.Ends()
        self.listeners: list[subprocess.Popen[bytes]] = []
        self.asks: subprocess.Popen[bytes] | None = None
        self.check: subprocess.Popen[bytes] | None = None
        self.started_s = self.check_started_s = time.monotonic()
        self.reported_s, self.report_after_s = self.started_s, REPORT_FIRST_S
        self.size, self.grown_s = 0, self.started_s  # of the timings
        self.ready_s: float | None = None
        self.ready = False
        self.note = self.down = self.refused = ""
        self.facts = machine_facts.read()
        self.packages, self.reports = "", 0
        self.over_s = self._over_s()

    def _over_s(self) -> "float | None":
        """Return when the lifetime is over: also at the date, unless this machine's clock is plainly wrong."""
        lifetime_s: float | None = self.options.lifetime
        ends_s: float | None = self.options.ends
        if lifetime_s is None:
            return None
        left_s = lifetime_s if ends_s is None else ends_s - time.time()
        return self.started_s + (max(0.0, min(left_s, lifetime_s)) if left_s > -WRONG_CLOCK_S else lifetime_s)

    def is_over(self) -> bool:
        """Return whether its lifetime is over."""
        return self.over_s is not None and time.monotonic() >= self.over_s

    def start(self) -> None:
        """Start everything; raise OSError for a command that cannot be started."""
        self.out.mkdir(parents=True, exist_ok=True)
        self.report("starting", None)
        extract(self.out)
        for one in self.kept:
            self._start(one)
        for argv in self.options.listener:
            self.listeners.append(self._popen(argv))
        if self.options.asks:
            with open(self.out / "asks.log", "wb") as log:
                self.asks = self._popen(self.options.asks, to=log)

    def _start(self, one: Kept) -> None:
        self.ends.look()
        one.process, one.due_s = self._popen(one.argv, one.name if one.marked else None), None
        one.started_s = self.started_s = time.monotonic()
        self.ends.watch(one.process)

    def _popen(
        self, argv: list[str], name: "str | None" = None, to: "IO[bytes] | None" = None
    ) -> "subprocess.Popen[bytes]":
        environment = processes.environment(self.out, self.timings)
        return self.output.start(
            processes.apart(argv), to, name, stdin=subprocess.DEVNULL, env=environment, start_new_session=True
        )

    def watch(self, signals: list[int]) -> str | None:
        """Watch until a node ends and return how; return None once a signal has been received."""
        begun_s = self.started_s
        while not signals:
            if self.is_over():
                return OVER
            ended = self.ends.new()
            for one in sorted(
                self.kept, key=lambda one: ended.index(one.process) if one.process in ended else len(ended)
            ):
                if (why := self._keep(one)) is not None:
                    return why
            self._watch_listeners()
            up = all(one.process is not None for one in self.kept)
            if up and not self.ready and self._is_ready():
                self.ready = True
                if self.ready_s is None:
                    self.ready_s = time.monotonic() - begun_s
                    self.packages, self.reports = packages.packed(packages.listed()), 0
                self._report_running()
            self._bound_files()
            self.shared_memory.look(processes.descendants)
            own = [one for one in (self.check, self.asks) if one is not None]
            processes.reap([*self._running(), *self.listeners, *own])
            if time.monotonic() - self.reported_s > self.report_after_s:
                self.report_after_s = min(2 * self.report_after_s, REPORT_EVERY_S)
                self._report_running()
            time.sleep(POLL_S)
        return None

    def _keep(self, one: Kept) -> str | None:
        """Start the process again when that is due; return why all end if it ended for good."""
        now_s = time.monotonic()
        if one.process is None:
            if one.due_s is not None and now_s >= one.due_s:
                one.restarts += 1
                self.down = ""
                self._start(one)
                self._report_running()
            return None
        if (code := one.process.poll()) is None:
            return None
        # What it had started itself would hold ports, devices and memory that its successor needs.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(one.process.pid, signal.SIGKILL)
        if (why := one.ended(code, now_s)) is not None:
            return why
        one.process, self.ready = None, False
        self._end_check()
        self.down = f"{one.name} {processes.exit_text(code)} and is started again, restart {one.restarts + 1}"
        self._report_running()
        return None

    def _running(self) -> "list[subprocess.Popen[bytes]]":
        return [one.process for one in self.kept if one.process is not None]

    def finish(self) -> None:
        """End all processes and what they left in shared memory."""
        self.shared_memory.look(processes.descendants, again=True)
        processes.finish(self._running() + self.listeners)
        self.shared_memory.remove()

    def _is_ready(self) -> bool:
        """Return True once the ready command succeeds; without one, after the first request or `ALIVE_S` seconds."""
        now_s = time.monotonic()
        if not self.options.ready:
            # Requests from before a restart say nothing of the process that took its place.
            with contextlib.suppress(OSError):
                if self.ready_s is None and self.timings.stat().st_size:
                    return True
            return now_s - self.started_s >= ALIVE_S
        if self.check is None:
            if now_s >= self.check_started_s:
                self.check_started_s = now_s + CHECK_EVERY_S
                with contextlib.suppress(OSError):
                    self.check = self._popen(self.options.ready)
            return False
        if (code := self.check.poll()) is None and now_s - self.check_started_s < CHECK_TIMEOUT_S:
            return False
        self._end_check()
        return code == 0

    def _end_check(self) -> None:
        if self.check is not None and self.check.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.check.pid, signal.SIGKILL)
            self.check.wait()
        self.check = None

    def _watch_listeners(self) -> None:
        for listener in self.listeners:
            if listener.poll() is not None and not self.note:
                self.note = f"latency is not observed: the listener ended with exit code {listener.returncode}"
                self._report_running()
        if self.asks is not None and self.asks.poll() is not None:
            asked, self.asks = self.asks, None
            if asked.returncode == REFUSED:
                self.output.settle(asked)
                self.refused = last_line(self.out / "asks.log")
                self._report_running()

    def _bound_files(self) -> None:
        """Keep timings and log from filling the disk, which would end the nodes."""
        with contextlib.suppress(OSError):
            size = self.timings.stat().st_size
            if size != self.size:
                self.size, self.grown_s = size, time.monotonic()
            if size > TIMINGS_LIMIT:
                os.replace(self.timings, self.out / "timings.1.jsonl")
        with contextlib.suppress(OSError):
            log = os.fstat(1)
            if stat.S_ISREG(log.st_mode) and log.st_size > LOG_LIMIT:
                os.ftruncate(1, 0)

    def _clock_s(self, requests: dict[str, list[list[Any]]]) -> float | None:
        """Return what time it is by the clock of the timings, whatever that is: their last moment, and how long ago it was."""
        moments = [row[4] for row in requests["latest"] if row[4] is not None] + [row[1] for row in requests["open"]]
        return max(moments) + time.monotonic() - self.grown_s if moments else None

    def _report_running(self) -> None:
        self.report("ready" if self.ready else "starting", None)

    def report(self, state: str, detail: str | None) -> None:
        """Write state.json atomically and a line to the log; ignore a full disk, which must not end the nodes."""
        public = read_tail(self.out / "link.pub", 4096).decode("ascii", "replace").strip()
        document: dict[str, Any] = {
            "state": state,
            "detail": detail or self.down or self.note or self.refused or None,
            "ready_s": self.ready_s,
            "restarts": {one.name: one.restarts for one in self.kept if one.respawn is not None},
            "observed": not self.note,
            "link": public,
            "server": machine_facts.between(self.facts, machine_facts.read()),
        }
        requests = latest(self.timings)
        document["clock_s"] = self._clock_s(requests)
        listed = {"packages": self.packages} if 0 < len(self.packages) <= PACKAGES_LIMIT else {}
        in_log = {} if self.reports % PACKAGES_EVERY else listed
        self.reports += 1
        self.reported_s = time.monotonic()
        with contextlib.suppress(OSError):
            part = self.out / "state.part"
            write_new(part, json.dumps({**document, **listed}) + "\n")
            os.replace(part, self.out / "state.json")
        with contextlib.suppress(OSError):
            print(
                f"=== fogspec state {json.dumps({**document, **in_log, **requests})} ===",
                flush=True,
            )


def latest(timings: Path) -> dict[str, list[list[Any]]]:
    """Return the latest requests: name, latency in seconds, success, scenario, end; and of open ones name and start.

    By the clock of the timings, in seconds.
    """
    rows, opened = list[list[Any]](), dict[Any, list[Any]]()
    for line in read_tail(timings, 65536).split(b"\n")[:-1]:
        with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError):
            record = json.loads(line)
            name = str(record.get("open", record.get("name")))[:256]
            one = name, record.get("process"), record.get("number")
            if "open" in record:
                opened[one] = [name, float(record["start_s"])]
                continue
            latency_s = round(float(record["latency_s"]), 6)
            opened.pop(one, None)
            end_s = float(record["start_s"]) + latency_s if "start_s" in record else None
            rows.append([name, latency_s, record["ok"] is True, record.get("scenario"), end_s])
    return {"latest": rows[-LATEST:], "open": list(opened.values())[-OPEN:]}


if __name__ == "__main__":
    sys.exit(main())
