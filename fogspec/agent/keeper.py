"""Keeps the cloud nodes of a deployment running: starts them, says when they answer, and ends all when one ends.

Standard library only (Python 3.10 or newer); opens no port. It runs on the deployed machine, beside agent.py:

    python3 keeper.py --out DIR [--ready '<json argv>'] [--secret NAME ...] --process '<json argv>' [--process ...]
                      [--listener ...]

DIR/state.json says how things stand: state (starting, ready, ended), detail, ready_s, observed, and the public half of
the link in DIR/link.pub. Probes append one JSON line a request to FOGSPEC_TIMINGS (DIR/timings.jsonl), which is set aside
as timings.1.jsonl when it is large, so that both together stay bounded. A listener only watches: it may end without ending
the nodes. What they print is passed on without the values of the variables that are secrets. For whoever can read no
file here, the log has the same every now and then, with the latest requests:

    === fogspec state {"state": "ready", ..., "latest": [[name, latency_s, ok, scenario], ...]} ===
"""

import argparse
import contextlib
import ctypes
import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import agent
import processes
import secrecy

POLL_S = 0.1
ALIVE_S = 2.0
ASK_EVERY_S = 1.0
ASK_PATIENCE_S = 30.0
TIMINGS_LIMIT = 4 * 2**20
LOG_LIMIT = 64 * 2**20
TELL_FIRST_S, TELL_EVERY_S = 10.0, 120.0
TOLD_AT_ONCE = 100


def main(arguments: list[str] | None = None) -> int:
    """Keep the processes until one ends (exit code 1) or a signal asks to stop (0)."""
    options = parse(arguments)
    asked: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda got, _frame: asked.append(got))
    # Processes that detach themselves stay below this one, so that they are ended too (Linux).
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(agent.PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    keeper = Keeper(options)
    try:
        keeper.start()
        detail = keeper.keep(asked)
    except OSError as problem:
        detail = f"cannot be started: {problem}"
    finally:
        processes.finish(keeper.nodes + keeper.listeners)
        keeper.output.settle()
    keeper.say("ended", detail)
    return 0 if asked else 1


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options; exits with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="keeper.py", allow_abbrev=False)
    parser.add_argument("--out", required=True)
    parser.add_argument("--ready", type=json.loads)
    parser.add_argument("--secret", action="append", default=[])
    parser.add_argument("--process", type=json.loads, action="append", required=True)
    parser.add_argument("--listener", type=json.loads, action="append", default=[])
    options = parser.parse_args(arguments)
    for argv in (*options.process, *options.listener, *([options.ready] if options.ready else [])):
        if not isinstance(argv, list) or not argv or not all(isinstance(word, str) for word in argv):
            parser.error("a command must be a JSON list of strings")
    return options


class Keeper:
    """The processes of one deployment, from their start to their end."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, Path(options.out).absolute()
        self.output = secrecy.Output(options.secret)
        self.nodes: list[subprocess.Popen[bytes]] = []
        self.listeners: list[subprocess.Popen[bytes]] = []
        self.asking: subprocess.Popen[bytes] | None = None
        self.begun = self.asked_at = time.monotonic()
        self.told_at, self.tell_after_s = self.begun, TELL_FIRST_S
        self.ready_s: float | None = None
        self.notes = ""

    def start(self) -> None:
        """Start everything; raises OSError for a command that cannot be started."""
        self.out.mkdir(parents=True, exist_ok=True)
        self.say("starting", None)
        for argv in self.options.process:
            self.nodes.append(self._begin(argv))
        for argv in self.options.listener:
            self.listeners.append(self._begin(argv))

    def _begin(self, argv: list[str]) -> "subprocess.Popen[bytes]":
        path = os.pathsep.join(filter(None, [agent.place(self.out), os.environ.get("PYTHONPATH")]))
        environment = dict(os.environ, PYTHONPATH=path, FOGSPEC_TIMINGS=str(self.out / "timings.jsonl"))
        options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "env": environment, "start_new_session": True}
        begun: subprocess.Popen[bytes] = self.output.start(argv, **options)
        return begun

    def keep(self, asked: list[int]) -> str | None:
        """Watch until a node ends, and say how; None when a signal asked to stop."""
        while not asked:
            for argv, node in zip(self.options.process, self.nodes, strict=True):
                if (code := node.poll()) is not None:
                    how = f"was ended by {processes.named(-code)}" if code < 0 else f"ended with exit code {code}"
                    return f"{os.path.basename(argv[0])} {how}"
            self._listeners_alive()
            if self.ready_s is None and self._answers():
                self.ready_s = time.monotonic() - self.begun
                self.say("ready", None)
            self._bound()
            if time.monotonic() - self.told_at > self.tell_after_s:
                self.tell_after_s = min(2 * self.tell_after_s, TELL_EVERY_S)
                self.say("starting" if self.ready_s is None else "ready", None)
            time.sleep(POLL_S)
        return None

    def _answers(self) -> bool:
        """Whether the nodes answer: the command says so; without one a request was timed, or they stayed alive a while."""
        now = time.monotonic()
        if not self.options.ready:
            with contextlib.suppress(OSError):
                if (self.out / "timings.jsonl").stat().st_size:
                    return True
            return now - self.begun >= ALIVE_S
        if self.asking is None:
            if now >= self.asked_at:
                self.asked_at = now + ASK_EVERY_S
                with contextlib.suppress(OSError):
                    self.asking = self._begin(self.options.ready)
            return False
        if (code := self.asking.poll()) is None and now - self.asked_at < ASK_PATIENCE_S:
            return False
        if code is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.asking.pid, signal.SIGKILL)
            self.asking.wait()
        self.asking = None
        return code == 0

    def _listeners_alive(self) -> None:
        for listener in self.listeners:
            if listener.poll() is not None and not self.notes:
                self.notes = f"latency is not observed: the listener ended with exit code {listener.returncode}"
                self.say("starting" if self.ready_s is None else "ready", None)

    def _bound(self) -> None:
        """Keep timings and log from filling the disk: a disk that is full would end the nodes."""
        timings = self.out / "timings.jsonl"
        with contextlib.suppress(OSError):
            if timings.stat().st_size > TIMINGS_LIMIT:
                os.replace(timings, self.out / "timings.1.jsonl")
        with contextlib.suppress(OSError):
            log = os.fstat(1)
            if stat.S_ISREG(log.st_mode) and log.st_size > LOG_LIMIT:
                os.ftruncate(1, 0)

    def say(self, state: str, detail: str | None) -> None:
        """Write state.json whole, and a line to the log; a disk that is full must not end the nodes."""
        said: dict[str, Any] = {
            "state": state, "detail": detail or self.notes or None, "ready_s": self.ready_s,
            "observed": not self.notes, "link": read_tail(self.out / "link.pub", 4096).decode("ascii", "replace").strip(),
        }  # fmt: skip
        self.told_at = time.monotonic()
        with contextlib.suppress(OSError):
            part = self.out / "state.part"
            part.write_text(json.dumps(said) + "\n", encoding="utf-8")
            os.replace(part, self.out / "state.json")
        with contextlib.suppress(OSError):
            print(f"=== fogspec state {json.dumps({**said, 'latest': latest(self.out)})} ===", flush=True)


def latest(out: Path) -> list[list[Any]]:
    """The latest requests in few words: name, latency, whether it succeeded, scenario."""
    rows = []
    for line in read_tail(out / "timings.jsonl", 65536).split(b"\n")[-TOLD_AT_ONCE - 1 : -1]:
        with contextlib.suppress(ValueError, KeyError, TypeError):
            one = json.loads(line)
            rows.append(
                [str(one["name"])[:256], round(float(one["latency_s"]), 6), one["ok"] is True, one.get("scenario")]
            )
    return rows


def read_tail(path: Path, most: int) -> bytes:
    """The end of a file; nothing where there is none."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - most))
        return file.read(most)
    return b""


if __name__ == "__main__":
    sys.exit(main())
