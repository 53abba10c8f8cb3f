"""Run the cloud nodes of a deployment: start them, report when they are ready, and end all when one ends.

    python3 agent.pyz supervisor --out DIR [--ready '<json argv>'] [--secret NAME ...]
                                 --process '<json argv>' [--process ...] [--listener ...]

DIR/state.json has the state (starting, ready, ended), detail, ready_s, observed, facts of the server, and the public half of
the link from DIR/link.pub. Probes append one line of JSON per request to FOGSPEC_TIMINGS (DIR/timings.jsonl), which is moved to
timings.1.jsonl when it is large, so that both together stay bounded. A listener only observes: its end does not end the
nodes. The output of all is passed on without the values of secret variables. For controllers that cannot read files on
this machine, the log regularly contains the same state with the latest requests:

    === fogspec state {"state": "ready", ..., "latest": [[name, latency_s, ok, scenario], ...]} ===
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
from pathlib import Path
from typing import Any

from . import machine_facts, processes, redaction
from .files import read_tail, write_new
from .sample import extract
from .shared_memory import SharedMemory

POLL_S = 0.1
ALIVE_S = 2.0
CHECK_EVERY_S = 1.0
CHECK_TIMEOUT_S = 30.0
TIMINGS_LIMIT = 4 * 2**20
LOG_LIMIT = 64 * 2**20
REPORT_FIRST_S, REPORT_EVERY_S = 10.0, 120.0
LATEST = 100


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the processes until one ends (return 1) or a signal requests the end (return 0)."""
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
    return 0 if signals else 1


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; exit with code 2 on a wrong command line."""
    parser = argparse.ArgumentParser(prog="supervisor", allow_abbrev=False)
    parser.add_argument("--out", required=True)
    parser.add_argument("--ready", type=json.loads)
    parser.add_argument("--secret", action="append", default=[])
    parser.add_argument("--process", type=json.loads, action="append", required=True)
    parser.add_argument("--listener", type=json.loads, action="append", default=[])
    options = parser.parse_args(arguments)
    for argv in (*options.process, *options.listener, *([options.ready] if options.ready else [])):
        if not processes.is_argv(argv):
            parser.error("a command must be a JSON list of strings")
    return options


class Supervisor:
    """The processes of one deployment, from their start to their end."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, Path(options.out).absolute()
        self.timings = self.out / "timings.jsonl"
        self.output = redaction.Output(options.secret)
        self.shared_memory = SharedMemory()
        self.nodes: list[subprocess.Popen[bytes]] = []
        self.listeners: list[subprocess.Popen[bytes]] = []
        self.check: subprocess.Popen[bytes] | None = None
        self.started_s = self.check_started_s = time.monotonic()
        self.reported_s, self.report_after_s = self.started_s, REPORT_FIRST_S
        self.ready_s: float | None = None
        self.note = ""
        self.facts = machine_facts.read()

    def start(self) -> None:
        """Start everything; raise OSError for a command that cannot be started."""
        self.out.mkdir(parents=True, exist_ok=True)
        self.report("starting", None)
        extract(self.out)
        for argv in self.options.process:
            self.nodes.append(self._popen(argv))
        for argv in self.options.listener:
            self.listeners.append(self._popen(argv))

    def _popen(self, argv: list[str]) -> "subprocess.Popen[bytes]":
        environment = processes.environment(self.out, self.timings)
        return self.output.start(
            processes.apart(argv), stdin=subprocess.DEVNULL, env=environment, start_new_session=True
        )

    def watch(self, signals: list[int]) -> str | None:
        """Watch until a node ends and return how; return None once a signal has been received."""
        while not signals:
            for argv, node in zip(self.options.process, self.nodes, strict=True):
                if (code := node.poll()) is not None:
                    return f"{os.path.basename(argv[0])} {processes.exit_text(code)}"
            self._watch_listeners()
            if self.ready_s is None and self._is_ready():
                self.ready_s = time.monotonic() - self.started_s
                self._report_running()
            self._bound_files()
            self.shared_memory.look(processes.descendants)
            processes.reap([*self.nodes, *self.listeners, *([self.check] if self.check else [])])
            if time.monotonic() - self.reported_s > self.report_after_s:
                self.report_after_s = min(2 * self.report_after_s, REPORT_EVERY_S)
                self._report_running()
            time.sleep(POLL_S)
        return None

    def finish(self) -> None:
        """End all processes and what they left in shared memory."""
        self.shared_memory.look(processes.descendants, again=True)
        processes.finish(self.nodes + self.listeners)
        self.shared_memory.remove()

    def _is_ready(self) -> bool:
        """Return True once the ready command succeeds; without one, after the first request or `ALIVE_S` seconds."""
        now_s = time.monotonic()
        if not self.options.ready:
            with contextlib.suppress(OSError):
                if self.timings.stat().st_size:
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
        if code is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.check.pid, signal.SIGKILL)
            self.check.wait()
        self.check = None
        return code == 0

    def _watch_listeners(self) -> None:
        for listener in self.listeners:
            if listener.poll() is not None and not self.note:
                self.note = f"latency is not observed: the listener ended with exit code {listener.returncode}"
                self._report_running()

    def _bound_files(self) -> None:
        """Keep timings and log from filling the disk, which would end the nodes."""
        with contextlib.suppress(OSError):
            if self.timings.stat().st_size > TIMINGS_LIMIT:
                os.replace(self.timings, self.out / "timings.1.jsonl")
        with contextlib.suppress(OSError):
            log = os.fstat(1)
            if stat.S_ISREG(log.st_mode) and log.st_size > LOG_LIMIT:
                os.ftruncate(1, 0)

    def _report_running(self) -> None:
        self.report("starting" if self.ready_s is None else "ready", None)

    def report(self, state: str, detail: str | None) -> None:
        """Write state.json atomically and a line to the log; ignore a full disk, which must not end the nodes."""
        public = read_tail(self.out / "link.pub", 4096).decode("ascii", "replace").strip()
        document: dict[str, Any] = {
            "state": state,
            "detail": detail or self.note or None,
            "ready_s": self.ready_s,
            "observed": not self.note,
            "link": public,
            "server": machine_facts.between(self.facts, machine_facts.read()),
        }
        self.reported_s = time.monotonic()
        with contextlib.suppress(OSError):
            part = self.out / "state.part"
            write_new(part, json.dumps(document) + "\n")
            os.replace(part, self.out / "state.json")
        with contextlib.suppress(OSError):
            print(f"=== fogspec state {json.dumps({**document, 'latest': latest(self.timings)})} ===", flush=True)


def latest(timings: Path) -> list[list[Any]]:
    """Return the latest requests: name, latency in seconds, success, scenario."""
    rows = []
    for line in read_tail(timings, 65536).split(b"\n")[-LATEST - 1 : -1]:
        with contextlib.suppress(ValueError, KeyError, TypeError):
            record = json.loads(line)
            name, latency_s = str(record["name"])[:256], round(float(record["latency_s"]), 6)
            rows.append([name, latency_s, record["ok"] is True, record.get("scenario")])
    return rows


if __name__ == "__main__":
    sys.exit(main())
