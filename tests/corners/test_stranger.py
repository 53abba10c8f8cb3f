"""Ten minutes of a stranger with nothing but Python: from the wheel to a node of one's own, measured, deployed and ended."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.corners.test_wheel import built, environment_with  # noqa: F401

NODE = """\
import time

import fogspec_probe

while True:
    fogspec_probe.start("plan")
    time.sleep(0.02)
    fogspec_probe.stop("plan")
"""
SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: planner}
spec:
  cloud: [{cmd: [python3, work.py]}]
  probe: {callback: plan}
  constraints: {latencyy: 50s}
  infra: [local]
  benchmark: {stop: {requests: 10, duration: 1min}}
"""
NEXT = re.compile(r"^(?:next: |\s+fix: |  )(fogspec [^\n]*)", re.MULTILINE)
pytestmark = pytest.mark.slow


class Stranger:
    """Types commands, and keeps what was typed and printed."""

    def __init__(self, environment: Path, home: Path) -> None:
        self.bin, self.here, self.transcript = environment / "bin", home, list[str]()

    def __call__(self, command: str, code: int = 0) -> str:
        path = f"{self.bin}:/usr/local/bin:/usr/bin:/bin"
        ended = subprocess.run(
            ["sh", "-c", command], cwd=self.here, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, timeout=1200, check=False,
            env={"PATH": path, "HOME": str(self.here), "LANG": "C.UTF-8", "COLUMNS": "80"},
        )  # fmt: skip
        self.transcript.append(f"$ {command}\n{ended.stdout}")
        assert ended.returncode == code, "".join(self.transcript)
        assert "Traceback" not in ended.stdout, ended.stdout
        return ended.stdout

    def follow(self, said: str, code: int = 0) -> str:
        """Type the command that was printed as the next one, or as the fix."""
        found = NEXT.findall(said)
        assert found, said
        return self(found[-1].partition(", ")[0], code)


def test_each_command_leads_to_the_next_until_nothing_is_left(built: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    run = Stranger(environment_with(tmp_path / "environment", sys.executable, built["wheel"]), tmp_path / "home")
    menu = run.follow(run("fogspec init --example grasp-planning"))
    assert ">  g4dn.xlarge" in menu
    assert "g4dn.xlarge" in run.follow(menu)  # explain
    assert "no machine meets the limits" in run("fogspec menu grasp-planning --latency 10ms", 4)
    run("fogspec report grasp-planning")

    (run.here / "specs/planner").mkdir()
    (run.here / "specs/planner/work.py").write_text(NODE)
    spec = run.here / "specs/planner/planner.yaml"
    spec.write_text(SPEC)
    assert "write 'latency'" in run("fogspec validate planner", 1)
    spec.write_text(SPEC.replace("latencyy", "latency"))
    compiled = run.follow(run("fogspec validate planner"))
    assert "shapes of this host" in compiled
    chosen = run.follow(run.follow(compiled))  # bench, compile
    assert chosen.startswith("planner\n  choice    ")
    assert len(chosen.splitlines()) <= 14 + chosen.count("warning: ")
    run("fogspec apply planner --dry-run")
    serving = run("fogspec apply planner --yes")
    try:
        assert "Synced, " in run.follow(serving)  # status
        assert "its nodes printed nothing" in run("fogspec logs planner")

        (run.here / "specs/planner/work.py").write_text(NODE + "# a change\n")
        stale = run("fogspec check planner", 3)
        assert "work.py changed" in stale
        # Compile, bench and compile again, in one line. On a busy host one sample may not confirm the older ones: all of them.
        run(NEXT.findall(stale)[-1].replace("--runner local", "--runner local --all"))
        run("fogspec check planner")
        run("fogspec apply planner --yes")
    finally:
        ended = run("fogspec down planner --yes")
    assert "nothing is left" in ended
    (found,) = json.loads(run("fogspec status planner -o json"))
    assert found["deployment"] is None
    assert [shlex.split(one.splitlines()[0])[2] for one in run.transcript[:3]] == ["init", "menu", "explain"]
