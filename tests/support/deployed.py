"""A tiny application that is measured and compiled for this host, and what runs of it."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from tests.support.forking import Ended, forked
from tests.support.once import once
from tests.support.scenes import environments, until

SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: tiny}
spec:
  cloud:
    - cmd: [python3, work.py]
  probe: {callback: work}
  constraints: {latency: 1s, cost: $0.01/1000 requests}
  objective: {alpha: 0.5}
  hardware: {cpus: 1..2, memory: 1GiB..2GiB}
  infra: [local]
  benchmark:
    machines: [local/1cpu-1gib, local/2cpu-1gib]
    warmup: 1
    ready_timeout: 1min
    stop: {requests: 10, duration: 1min}
"""
# What is timed follows a clock of the script's own, so that no prediction, limit or drift depends on this host's speed.
WORK = """\
import os, signal, sys, time
import fogspec_probe

class Clock:
    now_s = 0.0

    def monotonic(self):
        return self.now_s

clock = fogspec_probe.time = Clock()
took_s = float(os.environ.get("ROS_TOOK_S", "0.01"))
for number in range(int(os.environ.get("ROS_REQUESTS", sys.maxsize))):
    fogspec_probe.start("work")
    time.sleep(took_s)
    clock.now_s += took_s * (0.9 + 0.05 * (number % 5))
    fogspec_probe.stop("work")
signal.pause()
"""
HOSTS = """\
Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region
local,1cpu-1gib,1,1,0.02,
local,2cpu-1gib,2,1,0.04,
"""
MANIFEST = "compiled/tiny/manifest.yaml"


@dataclass(frozen=True)
class Deployed:
    """The application's folder, and the command line on it, each command a process as a user starts it."""

    folder: Path

    @classmethod
    def made(cls, folder: Path, spec: str = SPEC, hosts: str | None = HOSTS) -> "Deployed":
        """Measured by a real bench once for each spec, then copied; without a list of hosts, shapes have no price."""

        def measured(place: Path) -> None:
            for name, text in (("specs/tiny.yaml", spec), ("specs/work.py", WORK), ("hosts.csv", hosts)):
                if text is not None:
                    (place / name).parent.mkdir(exist_ok=True)
                    (place / name).write_text(text)
            for words in (["lock", *([] if hosts is None else ["--catalog", "hosts.csv"])], ["compile", "specs/tiny.yaml"],
                          ["bench", "specs/tiny.yaml", "--runner", "local"], ["compile", "specs/tiny.yaml"]):  # fmt: skip
                cls(place)(*words)
            shutil.rmtree(place / ".fogspec")

        shutil.copytree(once(f"deployed {spec} {hosts}", measured), folder, dirs_exist_ok=True)
        return cls(folder)

    def __call__(self, *words: str, code: int | None = 0, env: dict[str, str] | None = None) -> Ended:
        ended = forked(self.folder, words, env)
        assert "Traceback" not in ended.stderr, ended.stderr
        assert code is None or ended.returncode == code, f"{words}: {ended}"
        return ended

    def command(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "fogspec", *words]

    def begin(self, *words: str) -> "subprocess.Popen[str]":
        pipe = subprocess.PIPE
        return subprocess.Popen(
            self.command(*words), cwd=self.folder, stdout=pipe, stderr=pipe, text=True, stdin=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip

    def apply(self, *words: str, code: int | None = 0, env: dict[str, str] | None = None) -> Ended:
        return self("apply", MANIFEST, "--yes", *words, code=code, env=env)

    def change(self, old: str, new: str, name: str = "specs/tiny.yaml") -> None:
        path = self.folder / name
        before = path.read_text()
        assert old in before, before
        path.write_text(before.replace(old, new))

    @property
    def state(self) -> Path:
        return self.folder / ".fogspec" / "tiny"

    def machines(self) -> list[dict[str, Any]]:
        """What the live state says."""
        path = self.state / "deployment.yaml"
        return YAML(typ="safe", pure=True).load(path)["spec"]["machines"] if path.exists() else []

    def names(self) -> list[str]:
        return [machine["name"] for machine in self.machines()]

    def status(self) -> dict[str, Any]:
        return json.loads(self("status", "-o", "json").stdout)[0]["deployment"]

    def judged(self) -> dict[str, Any]:
        """The status once there were enough requests to judge, and contact."""
        seen: list[dict[str, Any]] = []

        def is_judged() -> bool:
            seen.append(self.status())
            return seen[-1]["health"] not in ("NotJudged", "Progressing", "Unknown")

        until(is_judged, pause_s=0.5)
        return seen[-1]

    def alive(self) -> list[int]:
        """Living processes whose output is below this application's state, whoever started them."""
        mark = f"FOGSPEC_OUT={self.state}{os.sep}".encode()
        return [pid for pid, words in environments() if any(word.startswith(mark) for word in words)]

    def left(self) -> list[str]:
        """Files of live state that are there though nothing runs; its record stays, with the history alone."""
        record = [self.state / "deployment.yaml"] if not self.machines() else []
        return [str(path) for path in self.state.rglob("*") if path not in record]

    def kill(self) -> None:
        for pid in self.alive():
            os.kill(pid, signal.SIGKILL)


@pytest.fixture
def app(tmp_path: Path) -> Iterator[Callable[..., Deployed]]:
    """Makes applications; whatever runs of them when the test is over is ended."""
    made: list[Deployed] = []

    def make(spec: str = SPEC, hosts: str | None = HOSTS) -> Deployed:
        made.append(Deployed.made(tmp_path / f"app-{len(made)}", spec, hosts))
        return made[-1]

    yield make
    for one in made:
        one.kill()


@pytest.fixture
def tiny(app: Callable[..., Deployed]) -> Deployed:
    """The application as it is."""
    return app()
