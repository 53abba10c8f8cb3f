"""A tiny application in a folder of its own, and the command line on it, as a user has both."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from fogspec.cli import main
from fogspec_lab import cli as lab
from tests.support.forking import Ended, forked
from tests.support.once import once
from tests.support.results import document

SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: tiny}
spec:
  cloud:
    - cmd: [python3, work.py]
  probe: {callback: work}
  constraints: {latency: 1s, cost: $1/request, confidence: none}
  hardware: {cpus: 1..4, memory: 1GiB..16GiB, allow: [c6i.*, m6i.*, c7i.*]}
  infra: [aws/us-east-1]
  benchmark:
    machines: [local/1cpu-1gib, local/2cpu-1gib]
    warmup: 1
    ready_timeout: 1min
    stop: {requests: 10, duration: 1min}
"""
WORK = """\
import time
import fogspec_probe
while True:
    fogspec_probe.start("work")
    time.sleep(0.01)
    fogspec_probe.stop("work")
"""
# Answers a few requests, then none until a file says that it may go on.
HALTING = """\
import os, time
import fogspec_probe
count = 0
while True:
    fogspec_probe.start("work")
    while count == 3 and not os.path.exists("../../../../../go"):  # from its copy of the folder
        time.sleep(0.01)
    time.sleep(0.01)
    fogspec_probe.stop("work")
    count += 1
"""


@dataclass(frozen=True)
class Scene:
    """The files of one application."""

    folder: Path
    name: str = "tiny"

    @classmethod
    def made(cls, folder: Path, work: str = WORK, spec: str = SPEC) -> "Scene":
        """Spec and workload, compiled; what was compiled before is copied, for it is the same in every folder."""

        def compiled(place: Path) -> None:
            first = cls(place)
            (place / "specs").mkdir()
            first.spec.write_text(spec)
            (place / "specs" / "work.py").write_text(work)
            assert first.run("compile").returncode == 0

        shutil.copytree(once(f"scene {spec} {work}", compiled), folder)
        return cls(folder)

    @property
    def spec(self) -> Path:
        return self.folder / "specs" / f"{self.name}.yaml"

    @property
    def results(self) -> Path:
        return self.folder / "results" / self.name

    def command(self, verb: str, *words: str) -> list[str]:
        return [sys.executable, "-m", "fogspec", verb, f"specs/{self.name}.yaml", *words]

    def run(self, verb: str, *words: str) -> Ended:
        """Run to the end; no command may ever show a traceback or leave half-written files."""
        run = lab.main if verb in lab.COMMANDS else main
        ended = forked(self.folder, [verb, f"specs/{self.name}.yaml", *words], patience_s=1200, run=run)
        assert "Traceback" not in ended.stdout + ended.stderr
        assert not [path for path in self.folder.rglob(".*.yaml.*") if path.is_file()]
        return ended

    def bench(self, *words: str) -> Ended:
        return self.run("bench", "--runner", "local", *words)

    def begin(self, *more: str) -> "subprocess.Popen[str]":
        """Start a bench and do not wait for it."""
        words = self.command("bench", "--runner", "local", *more)
        pipe = subprocess.PIPE
        return subprocess.Popen(words, cwd=self.folder, stdout=pipe, stderr=pipe, text=True, start_new_session=True)

    def records(self) -> dict[str, dict[str, Any]]:
        """What the results say, by sample."""
        if not self.results.exists():
            return {}
        return {record["id"]: record for record in document(self.results)["samples"]}

    def document(self, path: Path) -> Any:
        return YAML(typ="safe", pure=True).load(path)

    def events(self) -> list[dict[str, Any]]:
        """The journal's entries."""
        journal = self.folder / ".fogspec" / self.name / "journal.jsonl"
        return [json.loads(line) for line in journal.read_text().splitlines()] if journal.exists() else []

    def started(self) -> list[str]:
        """The samples that were started so far, in order."""
        return [event["sample"]["id"] for event in self.events() if event["do"] == "start"]

    def names(self) -> list[str]:
        return [event["name"] for event in self.events() if event["do"] == "start"]

    def alive(self) -> list[int]:
        """Living processes of any of its samples."""
        marks = tuple(f"FOGSPEC_JOB={name}@".encode() for name in self.names())
        return [pid for pid, words in environments() if any(word.startswith(marks) for word in words)]

    def requests(self) -> int:
        """Requests of the latest attempt so far."""
        names = self.names()
        path = (
            self.folder / ".fogspec" / self.name / "attempts" / names[-1] / "out" / "timings.jsonl" if names else None
        )
        return path.read_bytes().count(b'"latency_s"') if path is not None and path.exists() else 0


def tree(folder: Path) -> dict[str, bytes]:
    """Everything that a user keeps."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and ".fogspec" not in path.parts
    }


def environments() -> list[tuple[int, list[bytes]]]:
    found = []
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            found.append((int(entry), Path("/proc", entry, "environ").read_bytes().split(b"\0")))
        except OSError:
            continue
    return found


def tell(pids: Iterable[int], number: int) -> None:
    """Send a signal to processes, of which some may have ended meanwhile."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def until(true: Any, patience_s: float = 1200.0, pause_s: float = 0.05) -> None:
    """Wait until a condition holds; the patience only bounds hangs, and the pause between looks what they cost."""
    end = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(pause_s)
