"""Measure one sample: start its processes, watch their timings, stop them, and write the outcome.

    python3 agent.pyz sample --out DIR [--steps N] --after SECONDS --warmup N --startup SECONDS
                             [--precision P] [--decided-above SECONDS] [--statistic S] [--callback NAME]
                             [--expect NAME WHAT REQUESTS ...] [--asks '<json argv>'] [--afterwards '<json argv>']
                             [--progress] [--secret NAME ...]
                             --process '<json>' [--process ...]

A process is an argv, or a mapping `{"argv": [...], "name": ...}` with the name by which its end is reported, and `held` for
one that sends requests and is held back while the listener wants it, and until it heard all responses at the end. The processes
find the probe module on PYTHONPATH and append one line of JSON per request to FOGSPEC_TIMINGS (DIR/timings.jsonl). Their
output is kept without the values of secret variables. However the sample ends, DIR/outcome.json is written unless the agent
itself is killed: state (ok, timeout, failed), reason, detail, stopped_by, exit_codes, setup_s, duration_s, waited_s,
requests, unreadable lines, facts of the server, and the resources that were used.
DIR/packages.txt lists what the machine has installed.
"""

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import machine_facts, packages, processes, redaction, ros
from .declared import REFUSED
from .files import open_plain, read_tail, truncate, write_new
from .graph_variables import PLACE, RMW
from .holding import HELD
from .resources import Resources
from .shared_memory import SharedMemory
from .stopping import TIMINGS_LIMIT, Timings

# The zip application that this module was loaded from.
ARCHIVE = Path(__file__).parents[1]
POLL_S = 0.1
PROGRESS_EVERY_S = 2.0
ENDING_S = 60.0
ASKS_S = 15.0  # after the first request, for a sample that is shorter
MISNAMED = 0.1  # of the time for the first request, while only requests of other names finish
LOG_LIMIT = 16 * 2**20
LOG_LOOKED_AT, TRANSFORM = 2**18, "xtrapolation"  # what tf2 says of a stamp that it has no transform for
UNKNOWN = "it is not known whether the nodes declare the parameters that the spec sets"
AFTERWARDS_S = 300.0
OUTCOME_BYTES = 16384
OUT_OF_MEMORY = re.compile(r"MemoryError|bad_alloc|[Cc]annot allocate memory|[Oo]ut of memory")

End = tuple[str, str | None, str | None, str | None]  # state, reason, detail, stopped_by


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one sample; return 0 if it was measured, 1 otherwise."""
    options = parse(arguments)
    signals = processes.received_signals()
    started_s = time.monotonic()
    out = Path(options.out).absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
        reserve(out)
        outcome = SampleRun(options, out, started_s, signals).run()
    except OSError as problem:
        outcome = {"state": "failed", "reason": "setup", "detail": f"the agent could not work: {problem}"}
    outcome["duration_s"] = time.monotonic() - started_s
    write_outcome(out, outcome)
    return 0 if outcome["state"] == "ok" else 1


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; exit with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="sample", allow_abbrev=False)
    parser.add_argument("--out", required=True)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--after", type=float, required=True)
    parser.add_argument("--warmup", type=int, default=0)
    parser.add_argument("--startup", type=float, required=True)
    parser.add_argument("--precision", type=float)
    parser.add_argument("--decided-above", type=float, help="end as decided once the statistic is above this latency")
    parser.add_argument("--statistic", choices=("mean", "p50", "p95", "p99"), default="mean")
    parser.add_argument("--weights", type=json.loads, help="those of scenarios, by name")
    parser.add_argument("--callback", help="count requests of this name only; without it, all")
    parser.add_argument("--expect", action="append", nargs=3, default=[], help="a name to hear in so many requests")
    parser.add_argument("--asks", type=json.loads, help="asks the nodes whether they have what the spec sets")
    parser.add_argument("--afterwards", type=json.loads, help="writes the records once the processes have ended")
    parser.add_argument("--secret", action="append", default=[], help="a variable whose value is not to be printed")
    parser.add_argument("--progress", action="store_true", help="print the number of requests now and then")
    parser.add_argument("--process", type=json.loads, action="append", required=True)
    options = parser.parse_args(arguments)
    given = [one if isinstance(one, dict) else {"argv": one} for one in options.process]
    options.process, names = [one.get("argv") for one in given], [one.get("name") for one in given]
    options.held = [number for number, one in enumerate(given) if one.get("held")]
    others = [one for one in (options.asks, options.afterwards) if one is not None]
    if not all(map(processes.is_argv, [*options.process, *others])):
        parser.error("--process must be a JSON list of strings, or a mapping with it as argv")
    options.names = [str(name or processes.program(argv)) for name, argv in zip(names, options.process, strict=True)]
    both = zip(options.names, options.process, strict=True)
    options.commands = processes.told_apart(
        name if options.names.count(name) == 1 else processes.shown(argv) for name, argv in both
    )
    return options


class SampleRun:
    """One run of the processes, from their start to their end."""

    def __init__(self, options: argparse.Namespace, out: Path, started_s: float, signals: list[int]) -> None:
        self.options, self.out, self.started_s, self.signals = options, out, started_s, signals
        self.children: list[subprocess.Popen[bytes]] = []
        self.ends, self.ended = processes.Ends(), list[int]()  # which of them have ended, in this order
        self.held: set[int] | None = None  # the processes that are held back
        self.asks: subprocess.Popen[bytes] | None = None
        self.output = redaction.Output(options.secret)
        self.shared_memory = SharedMemory()
        self.timings = Timings(out / "timings.jsonl", options.warmup, options.callback, options.weights)
        self.timings.expected = options.expect
        self.environment = ros.alone(processes.environment(out, self.timings.path))
        self.setup_s: float | None = None
        self.misnamed_s: float | None = None
        self.valid_s: float | None = None
        self.last_request_s: float | None = None
        self.next_progress_s = started_s
        self.resources = Resources()

    def run(self) -> dict[str, Any]:
        """Return the outcome, without its duration."""
        processes.adopt_orphans()
        kills = processes.memory_kills()
        before = machine_facts.read()
        try:
            state, reason, detail, stopped_by = self._start() or self._watch()
            waited_s = self._waited_s(stopped_by)
            server = machine_facts.between(before, machine_facts.read())
            resources = self.resources.end()
            if state == "ok" and self.options.held and self.timings.hold is not None:
                state, reason, detail, stopped_by = self._all_answered(detail, stopped_by)
            if state == "ok":
                state, reason, detail, stopped_by = self._asked(stopped_by, detail)
        finally:
            self.resources.gpus.close()
            killed = processes.memory_kills() > kills
            self._hold(False)
            self.shared_memory.look(processes.descendants, again=True)
            processes.finish(self.children)
            self.shared_memory.remove()
            self.output.settle()
        with contextlib.suppress(OSError):
            write_new(self.out / "packages.txt", packages.listed())
        if stopped_by not in (None, "exit"):
            self.timings.cut()
        if self.options.afterwards:
            state, reason, detail = self._read_afterwards(state, reason, detail)
        # The kernel may kill one of several processes while the others wait for it or fail differently.
        if killed and (state == "timeout" or reason in ("crash", "no_response")):
            cause = "the kernel ended a process for lack of memory"
            state, reason, detail = "failed", "out_of_memory", f"{detail}; {cause}" if detail else cause
        self.timings.read()
        if state == "ok" and (missing := self._unheard(time.monotonic(), over=True)):
            detail = "; ".join(filter(None, (detail, missing[0])))
            state, reason = ("failed", "not_reported") if missing[1] else (state, reason)
        return {
            "state": state,
            "reason": reason,
            "detail": detail,
            "stopped_by": stopped_by,
            "exit_codes": [child.returncode for child in self.children],
            "setup_s": self.setup_s,
            "waited_s": waited_s,
            "requests": self.timings.requests,
            "unreadable": self.timings.unreadable,
            "server": server,
            "resources": resources,
        }

    def _waited_s(self, stopped_by: str | None) -> float | None:
        """Return the time since the last finished request.

        None if it indicates nothing: a process that has ended may have been the one that sent requests.
        """
        if stopped_by not in ("time", "signal") or self.last_request_s is None:
            return None
        if any(child.poll() is not None for child in self.children):
            return None
        return time.monotonic() - self.last_request_s

    def _start(self) -> End | None:
        extract(self.out)
        self.timings.path.write_bytes(b"")
        for number, argv in enumerate(self.options.process):
            self.ends.look()
            try:
                self.children.append(self._started(argv, self._log(number), self.options.commands[number]))
            except OSError as problem:
                return "failed", "setup", f"{argv[0]} cannot be started: {problem.strerror}", None
            self.ends.watch(self.children[-1])
        if self.options.asks:
            self.asks = self._started(self.options.asks, self.out / "asks.log")
        return None

    def _started(self, argv: list[str], path: Path, command: str = "") -> "subprocess.Popen[bytes]":
        # In append mode a log can be truncated while its process writes to it.
        with open(path, "ab") as log:
            return self.output.start(
                processes.apart(argv),
                log,
                stdin=subprocess.DEVNULL,
                env={**self.environment, "FOGSPEC_COMMAND": command},
                start_new_session=True,
            )

    def _read_afterwards(
        self, state: str, reason: str | None, detail: str | None
    ) -> tuple[str, str | None, str | None]:
        """Run the program that writes the records; its failure counts only if nothing else went wrong."""
        log = self.out / "afterwards.log"
        started = time.time() - (time.monotonic() - self.started_s)
        environment = self.environment | {"FOGSPEC_BEGUN": str(started)}
        message = ""
        with open(log, "wb") as file, contextlib.suppress(subprocess.TimeoutExpired, OSError):
            ended = subprocess.run(
                processes.apart(self.options.afterwards),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                timeout=AFTERWARDS_S,
            )
            message = last_line(log) if ended.returncode else ""
        self.timings.read()
        if state != "ok" or self.timings.valid:
            return state, reason, detail
        message = message or f"nothing was timed within {AFTERWARDS_S:g} s after the end{self._notes()}"
        return "failed", "no_response", message

    def _log(self, number: int) -> Path:
        return self.out / f"process-{number}.log"

    def _watch(self) -> End:
        while True:
            codes = [child.poll() for child in self.children]
            self._read()
            self._hold(self.timings.hold)
            self._look_at_resources()
            self._print_progress()
            self.shared_memory.look(processes.descendants)
            processes.reap([*self.children, *([self.asks] if self.asks else [])])
            end = (
                self._cannot()
                or self._refused()
                or self._enough()
                or self._exited(codes)
                or self._late(time.monotonic())
            )
            if end:
                return end
            for number in range(len(self.children)):
                with contextlib.suppress(OSError):
                    if os.lstat(self._log(number)).st_size > LOG_LIMIT:
                        truncate(self._log(number), 0)
            time.sleep(POLL_S)

    def _refused(self) -> End | None:
        """Return that the nodes lack what the spec sets, once that is certain: something else would be measured."""
        if self.asks is None or self.asks.poll() != REFUSED:
            return None
        self.output.settle(self.asks)
        return "failed", "not_reported", last_line(self.out / "asks.log"), "startup"

    def _hold(self, back: bool | None) -> None:
        """Hold back what sends requests, or let it go on; a file tells the listener which."""
        if back and self.held is None and self.options.held:
            senders = [self.children[number] for number in self.options.held]
            roots = [one.pid for one in senders if one.poll() is None]
            self.held = set()
            while new := {*roots, *processes.below(roots, processes.living())} - self.held:
                self.held |= new
                processes.send(new, signal.SIGSTOP)
            (self.out / HELD).touch()
        elif not back and self.held is not None:
            (self.out / HELD).unlink(missing_ok=True)
            processes.send(self.held, signal.SIGCONT)
            self.held = None

    def _cannot(self) -> End | None:
        """Return that the listener cannot measure this."""
        why = self.timings.refused
        return None if why is None or not self.options.held else ("failed", "not_reported", why, None)

    def _all_answered(self, detail: str | None, stopped_by: str | None) -> End:
        """Return the end of a valid sample once the listener has heard all responses, or that it has not."""
        until_s = time.monotonic() + ENDING_S
        while (
            not self.timings.ended and self.timings.refused is None and not self.signals and time.monotonic() < until_s
        ):
            self._hold(True)
            time.sleep(POLL_S)
            self._read()
        if self.timings.ended or self.timings.refused is not None:
            return self._cannot() or ("ok", None, detail, stopped_by)
        return "failed", "not_reported", "the listener did not say whether it heard all responses", stopped_by

    def _asked(self, stopped_by: str | None, detail: str | None) -> End:
        """Return the end of a valid sample once the nodes were asked; say so if their answer stays unknown."""
        until_s = self.started_s + (self.setup_s or 0.0) + ASKS_S
        while self.asks is not None and self.asks.poll() is None and stopped_by != "exit" and not self.signals:
            if time.monotonic() >= until_s:
                break
            time.sleep(POLL_S)
        if self.asks is not None and self.asks.poll() not in (0, REFUSED):
            detail = "; ".join(filter(None, (detail, UNKNOWN)))
        return self._refused() or ("ok", None, detail, stopped_by)

    def _read(self) -> None:
        if self.timings.read():
            self.last_request_s = time.monotonic()
            self.setup_s = self.last_request_s - self.started_s if self.setup_s is None else self.setup_s

    def _look_at_resources(self) -> None:
        """Look at them once requests are measured; where a program reads the records afterwards, from the start."""
        if self.options.afterwards or self.timings.counted or self.timings.warmup.is_over():
            self.resources.begin()
        self.resources.look()

    def _print_progress(self) -> None:
        if self.options.progress and self.timings.requests and time.monotonic() >= self.next_progress_s:
            self.next_progress_s = time.monotonic() + PROGRESS_EVERY_S
            print(f"=== fogspec so far: {self.timings.summary()} ===", flush=True)

    def _enough(self) -> End | None:
        options, timings = self.options, self.timings
        if options.steps is not None and timings.counted >= options.steps:
            return "ok", None, None, "steps"
        if timings.due():
            if options.precision is not None and timings.precise(options.precision, options.statistic):
                return "ok", None, None, "precision"
            if options.decided_above is not None and timings.above(options.decided_above, options.statistic):
                return "ok", None, None, "decided"
        if timings.offset >= TIMINGS_LIMIT:
            return "ok", None, f"the timings file reached {TIMINGS_LIMIT >> 20} MiB", "size"
        return None

    def _exited(self, codes: list[int | None]) -> End | None:
        if self.signals:
            self._read()  # what was measured by then is not cut off
            return "failed", "interrupted", f"ended by {processes.signal_name(self.signals[0])}", "signal"
        self.ended += map(self.children.index, self.ends.new())
        for place, number in enumerate(self.ended):
            if code := codes[number]:
                return self._crashed(number, code, self.ended[:place])
        if None in codes:
            return None
        self._read()
        if not self.timings.requests and not self.options.afterwards:
            return "failed", "no_response", f"the processes ended without one timed request{self._notes()}", "exit"
        return "ok", None, None, "exit"

    def _crashed(self, number: int, code: int, before: list[int]) -> End:
        self.output.settle(self.children[number])
        message = last_line(self._log(number))
        reason = "out_of_memory" if OUT_OF_MEMORY.search(message) else "crash"
        detail = f"{self.options.names[number]} {processes.exit_text(code)}"
        return "failed", reason, (f"{detail}: {message}" if message else detail) + self._gone(before), "exit"

    def _gone(self, numbers: list[int]) -> str:
        """Return which processes had ended without an error: the others may have failed for lack of them."""
        names = [self.options.names[number] for number in numbers]
        return f"; {', '.join(names)} had ended before, with exit code 0" if names else ""

    def _late(self, now_s: float) -> End | None:
        if self.options.afterwards:
            return ("ok", None, None, "time") if now_s - self.started_s >= self.options.after else None
        if self.setup_s is None:
            if wrong := self._misnamed(now_s):
                return "failed", "not_reported", wrong, "startup"
            if now_s - self.started_s < self.options.startup:
                return None
            detail = f"no timed request within {self.options.startup:g} s of the start{self._notes()}{self._gone(self.ended)}"
            return "failed", "no_response", detail, "startup"
        if (missing := self._unheard(now_s)) and missing[1]:
            return "failed", "not_reported", missing[0], "startup"
        if now_s - self.started_s - self.setup_s < self.options.after:
            return None
        return "ok" if self.timings.valid else "timeout", None, None, "time"

    def _misnamed(self, now_s: float) -> str | None:
        """Return why to wait no longer for the first request: the node times other names, or publishes other topics.

        At once for a slip of the keyboard. Otherwise the node may time other work first.
        """
        found = self.timings.misnamed()
        if found is None:
            return None
        self.misnamed_s = now_s if self.misnamed_s is None else self.misnamed_s
        what, slip = found
        patient = not slip and now_s - self.misnamed_s < MISNAMED * self.options.startup
        return None if patient else what

    def _unheard(self, now_s: float, over: bool = False) -> tuple[str, bool] | None:
        """Return which metrics and scenarios were not heard so far, and whether to wait no longer."""
        self.valid_s = now_s if self.valid_s is None and self.timings.valid else self.valid_s
        return self.timings.unheard(now_s - (now_s if self.valid_s is None else self.valid_s), over)

    def _notes(self) -> str:
        count, found = self.timings.unreadable, [self.timings.note, self._elsewhere()]
        for number, name in enumerate(self.options.names):
            if line := last_line(self._log(number), TRANSFORM, LOG_LOOKED_AT):
                found.append(f"{name}: {line}")
        found.append(f"unreadable lines in its timings: {count}" if count else None)
        text = "; ".join(filter(None, found))
        return f": {text}" if self.timings.note else f"; {text}" if text else ""

    def _elsewhere(self) -> str | None:
        """Return which process is in another graph than the sample's, by the environment that it was started with."""
        for pid in processes.descendants():
            with contextlib.suppress(OSError):
                text = Path(f"/proc/{pid}/environ").read_bytes().decode("utf-8", "replace")
                theirs = dict(one.partition("=")[::2] for one in text.split("\0"))
                if not theirs.keys() & {"AMENT_PREFIX_PATH", RMW, *PLACE}:
                    continue
                for name in (RMW, *PLACE):
                    if theirs.get(name) != self.environment.get(name):
                        has, whose = theirs.get(name, "none"), theirs.get("FOGSPEC_COMMAND") or f"process {pid}"
                        return f"{whose} has {name} {has}, and the sample {self.environment.get(name, 'none')}"
        return None


def extract(out: Path) -> None:
    """Extract the modules that the processes import, and the C++ header, to `out`/python, the first entry of PYTHONPATH.

    A copy, because the archive may be replaced while the processes run.
    """
    with zipfile.ZipFile(ARCHIVE) as archive:
        archive.extractall(out / "python", [name for name in archive.namelist() if name.startswith("fogspec_")])


def last_line(path: Path, having: str = "", looked_at: int = 4096) -> str:
    """Return the last non-empty line of a log that has this text, without control characters, at most 300 characters."""
    lines = read_tail(path, looked_at).decode("utf-8", "replace").splitlines()
    found = [line.strip() for line in lines if line.strip() and having in line]
    return "".join(c for c in found[-1] if c.isprintable())[:300] if found else ""


def reserve(out: Path) -> None:
    """Allocate the outcome's space now, so that it can be written even if the workload fills the disk."""
    with open(out / "outcome.part", "wb") as file:
        file.write(b" " * OUTCOME_BYTES)
        file.flush()
        os.fsync(file.fileno())


def write_outcome(out: Path, outcome: dict[str, Any]) -> None:
    """Write the outcome into the reserved space and rename it; print it to standard error if that fails."""
    text = json.dumps(outcome) + "\n"
    try:
        with open(open_plain(out / "outcome.part", os.O_RDWR), "r+b") as file:
            file.write(text.encode())
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
        os.replace(out / "outcome.part", out / "outcome.json")
    except OSError as problem:
        print(f"fogspec agent: {problem}; {text}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
