"""The on-machine agent: starts one sample's processes, watches their timings, stops, and says what happened.

Standard library only (Python 3.10 or newer); opens no port. It runs on every sampled machine:

    python3 agent.py --out DIR [--steps N] --after SECONDS --warmup W --startup SECONDS
                     [--precision P --statistic S] [--callback NAME] [--afterwards '<json argv>']
                     [--tell] [--secret NAME ...] --process '<json argv>' [--process ...]

The processes find the probe module on PYTHONPATH and append one JSON line a request to FOGSPEC_TIMINGS
(DIR/timings.jsonl). What they print is kept without the values of the variables that are secrets. DIR/outcome.json is
written in every end that leaves the agent alive: state (ok, timeout, failed), reason, detail, stopped_by, exit_codes,
setup_s, duration_s, waited_s and counts.
"""

import argparse
import contextlib
import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

# On a machine this file runs by itself, beside the other.
if TYPE_CHECKING or __package__:
    from . import processes, secrecy
    from .counting import TIMINGS_LIMIT, Timings
else:
    import processes
    import secrecy
    from counting import TIMINGS_LIMIT, Timings

POLL_S = 0.1
TELL_S = 2.0
LOG_LIMIT = 16 * 2**20
AFTERWARDS_S = 300.0
PR_SET_CHILD_SUBREAPER = 36
MEMORY_WORDS = re.compile(r"MemoryError|bad_alloc|[Cc]annot allocate memory|[Oo]ut of memory")

End = tuple[str, str | None, str | None, str | None]  # state, reason, detail, stopped_by


def main(arguments: list[str] | None = None) -> int:
    """Run one sample; exit code 0 when it was measured, 1 otherwise."""
    options = parse(arguments)
    asked: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda got, _frame: asked.append(got))
    begun = time.monotonic()
    out = Path(options.out).absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
        reserve(out)
        outcome = _Run(options, out, begun, asked).run()
    except OSError as problem:
        outcome = {"state": "failed", "reason": "setup", "detail": f"the agent could not work: {problem}"}
    outcome["duration_s"] = time.monotonic() - begun
    write_outcome(out, outcome)
    return 0 if outcome["state"] == "ok" else 1


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options; exits with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="agent.py", allow_abbrev=False)
    parser.add_argument("--out", required=True)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--after", type=float, required=True)
    parser.add_argument("--warmup", type=int, default=0)
    parser.add_argument("--startup", type=float, required=True)
    parser.add_argument("--precision", type=float)
    parser.add_argument("--statistic", choices=("mean", "p50", "p95", "p99"), default="mean")
    parser.add_argument("--callback", help="count requests of this name only; without it, all")
    parser.add_argument("--afterwards", type=json.loads, help="writes the records once the processes have ended")
    parser.add_argument("--secret", action="append", default=[], help="a variable whose value is not to be printed")
    parser.add_argument("--tell", action="store_true", help="print how far it is, now and then")
    parser.add_argument("--process", type=json.loads, action="append", required=True)
    options = parser.parse_args(arguments)
    for argv in [*options.process, *([options.afterwards] if options.afterwards is not None else [])]:
        if not isinstance(argv, list) or not argv or not all(isinstance(word, str) for word in argv):
            parser.error("--process must be a JSON list of strings")
    return options


class _Run:
    """One run of the processes, from their start to their end."""

    def __init__(self, options: argparse.Namespace, out: Path, begun: float, asked: list[int]) -> None:
        self.options, self.out, self.begun, self.asked = options, out, begun, asked
        self.children: list[subprocess.Popen[bytes]] = []
        self.output = secrecy.Output(options.secret)
        self.timings = Timings(out / "timings.jsonl", options.warmup, options.callback)
        self.setup_s: float | None = None
        self.last: float | None = None
        self.tells = begun

    def run(self) -> dict[str, Any]:
        # Processes that detach themselves stay below this one, so that they are ended too (Linux).
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        kills = processes.memory_kills()
        try:
            state, reason, detail, stopped_by = self._start() or self._watch()
            waited_s = self._waited_s(stopped_by)
        finally:
            killed = processes.memory_kills() > kills
            processes.finish(self.children)
            self.output.settle()
        if stopped_by not in (None, "exit"):
            self.timings.cut()
        if self.options.afterwards:
            state, reason, detail = self._read_afterwards(state, reason, detail)
        # One of several processes may be gone and the others wait for it, or say something else.
        if killed and (state == "timeout" or reason in ("crash", "no_response")):
            said = "the kernel ended a process for want of memory"
            state, reason, detail = "failed", "out_of_memory", f"{detail}; {said}" if detail else said
        self.timings.read()
        return {
            "state": state, "reason": reason, "detail": detail, "stopped_by": stopped_by,
            "exit_codes": [child.returncode for child in self.children], "setup_s": self.setup_s,
            "waited_s": waited_s, "requests": self.timings.requests, "unreadable": self.timings.unreadable,
        }  # fmt: skip

    def _waited_s(self, stopped_by: str | None) -> float | None:
        """Since the last request was finished; None where that tells nothing: a process that has ended may have asked."""
        if stopped_by not in ("time", "signal") or self.last is None:
            return None
        return time.monotonic() - self.last if all(child.poll() is None for child in self.children) else None

    def _start(self) -> End | None:
        place(self.out)
        environment = self._environment()
        self.timings.path.write_bytes(b"")
        for number, argv in enumerate(self.options.process):
            # Appending lets a log be cut while its process goes on writing.
            with open(self._log(number), "ab") as log:
                try:
                    self.children.append(self.output.start(
                        argv, log, stdin=subprocess.DEVNULL, env=environment, start_new_session=True))  # fmt: skip
                except OSError as problem:
                    return "failed", "setup", f"{argv[0]} cannot be started: {problem.strerror}", None
        return None

    def _environment(self) -> dict[str, str]:
        path = os.pathsep.join(filter(None, [str(self.out / "python"), os.environ.get("PYTHONPATH")]))
        return dict(os.environ, PYTHONPATH=path, FOGSPEC_TIMINGS=str(self.timings.path))

    def _read_afterwards(
        self, state: str, reason: str | None, detail: str | None
    ) -> tuple[str, str | None, str | None]:
        """Have the records written by what reads them; what it cannot read matters when there is nothing else wrong."""
        log = self.out / "afterwards.log"
        environment = self._environment() | {"FOGSPEC_BEGUN": str(time.time() - (time.monotonic() - self.begun))}
        words = ""
        with open(log, "wb") as file, contextlib.suppress(subprocess.TimeoutExpired, OSError):
            code = subprocess.run(self.options.afterwards, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                                  env=environment, timeout=AFTERWARDS_S).returncode  # fmt: skip
            words = last_line(log) if code else ""
        self.timings.read()
        if state != "ok" or self.timings.valid:
            return state, reason, detail
        return (
            "failed",
            "no_response",
            words or f"nothing was timed within {AFTERWARDS_S:g} s after the end{self._why()}",
        )

    def _log(self, number: int) -> Path:
        return self.out / f"process-{number}.log"

    def _watch(self) -> End:
        while True:
            codes = [child.poll() for child in self.children]
            self._read()
            self._tell()
            end = self._enough() or self._died(codes) or self._late(time.monotonic())
            if end:
                return end
            for number in range(len(self.children)):
                if self._log(number).stat().st_size > LOG_LIMIT:
                    os.truncate(self._log(number), 0)
            time.sleep(POLL_S)

    def _read(self) -> None:
        if self.timings.read():
            self.last = time.monotonic()
            self.setup_s = self.last - self.begun if self.setup_s is None else self.setup_s

    def _tell(self) -> None:
        if self.options.tell and self.timings.requests and time.monotonic() >= self.tells:
            self.tells = time.monotonic() + TELL_S
            print(f"=== fogspec so far: {self.timings.so_far()} ===", flush=True)

    def _enough(self) -> End | None:
        options, timings = self.options, self.timings
        if options.steps is not None and timings.requests >= options.steps + options.warmup:
            return "ok", None, None, "steps"
        if options.precision is not None and timings.precise(options.precision, options.statistic):
            return "ok", None, None, "precision"
        if timings.offset >= TIMINGS_LIMIT:
            return "ok", None, f"the timings file reached {TIMINGS_LIMIT >> 20} MiB", "size"
        return None

    def _died(self, codes: list[int | None]) -> End | None:
        if self.asked:
            return "failed", "interrupted", f"ended by {processes.named(self.asked[0])}", "signal"
        for number, code in enumerate(codes):
            if code:
                return self._crash(number, code)
        if None in codes:
            return None
        self._read()
        if not self.timings.requests and not self.options.afterwards:
            return "failed", "no_response", f"the processes ended without one timed request{self._why()}", "exit"
        return "ok", None, None, "exit"

    def _crash(self, number: int, code: int) -> End:
        self.output.settle(self.children[number])
        words, program = last_line(self._log(number)), os.path.basename(self.options.process[number][0])
        how = f"was ended by {processes.named(-code)}" if code < 0 else f"ended with exit code {code}"
        reason = "out_of_memory" if MEMORY_WORDS.search(words) else "crash"
        return "failed", reason, f"{program} {how}" + (f": {words}" if words else ""), "exit"

    def _late(self, now: float) -> End | None:
        if self.options.afterwards:
            return ("ok", None, None, "time") if now - self.begun >= self.options.after else None
        if self.setup_s is None:
            if now - self.begun < self.options.startup:
                return None
            detail = f"no timed request within {self.options.startup:g} s of the start{self._why()}"
            return "failed", "no_response", detail, "startup"
        if now - self.begun - self.setup_s < self.options.after:
            return None
        return "ok" if self.timings.valid else "timeout", None, None, "time"

    def _why(self) -> str:
        count, note = self.timings.unreadable, self.timings.note
        return (f": {note}" if note else "") + (f"; unreadable lines in its timings: {count}" if count else "")


def place(out: Path) -> str:
    """Put what the processes may import below `out`, and return the folder for PYTHONPATH.

    A folder of its own: beside this file stand modules that must not shadow somebody's. What user code imports is there
    by its name, what runs by itself in a package.
    """
    folder = out / "python"
    package = folder / "fogspec_machine"
    package.mkdir(parents=True, exist_ok=True)
    for source in (file for file in Path(__file__).parent.iterdir() if file.is_file()):
        shutil.copy(source, (folder if source.name.startswith("fogspec_") else package) / source.name)
    (package / "__init__.py").touch()
    return str(folder)


def last_line(path: Path) -> str:
    """The last line of a log that says something, without control characters, 300 characters at most."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, path.stat().st_size - 4096))
            lines = file.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return ""
    words = [line.strip() for line in lines if line.strip()]
    return "".join(c for c in words[-1] if c.isprintable())[:300] if words else ""


def reserve(out: Path) -> None:
    """Take the outcome's space now: a disk that the workload fills must not silence it."""
    with open(out / "outcome.part", "wb") as file:
        file.write(b" " * 16384)
        file.flush()
        os.fsync(file.fileno())


def write_outcome(out: Path, outcome: dict[str, Any]) -> None:
    """Write into the reserved space, then rename; on standard error when even that fails."""
    text = json.dumps(outcome) + "\n"
    try:
        with open(out / "outcome.part", "r+b") as file:
            file.write(text.encode())
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
        os.replace(out / "outcome.part", out / "outcome.json")
    except OSError as problem:
        print(f"fogspec agent: {problem}; {text}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
