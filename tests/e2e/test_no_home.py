"""A user without HOME and without a name, as in a container that runs under any number: every verb works as for others."""

import subprocess
import sys
from pathlib import Path

from fogspec.cli import ENDS

# As where the password file does not have the user.
NAMELESS = """\
import os, pwd, sys
def unknown(user): raise KeyError(user)
pwd.getpwuid = unknown
os.environ.pop("HOME", None)
from fogspec.__main__ import main
main()
"""
SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: arm}
spec:
  cloud: [{cmd: [python3, work.py]}]
  probe: {callback: plan}
  constraints: {latency: 30s, confidence: none}
  infra: [local]
  benchmark: {machines: [local/1cpu-1gib], warmup: 0, ready_timeout: 2min, stop: {requests: 10, duration: 2min}}
"""
WORK = """\
import time

import fogspec_probe

while True:
    with fogspec_probe.request("plan"):
        time.sleep(0.001)
"""
LIST = "Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region\nlocal,1cpu-1gib,1,1,0.02,\n"


DOWN = "down arm"


def nameless(folder: Path, line: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", NAMELESS, *line.split()], cwd=folder, capture_output=True, text=True, check=False,
        env={"PATH": "/usr/bin:/bin"},
    )  # fmt: skip


def test_every_verb_without_home_and_name(tmp_path: Path) -> None:
    (tmp_path / "specs").mkdir()
    for name, text in (("specs/arm.yaml", SPEC), ("specs/work.py", WORK), ("lab.csv", LIST)):
        (tmp_path / name).write_text(text)
    lines = (
        "init another", "validate arm", "lock arm --catalog lab.csv", "compile arm", "bench arm --yes --runner local",
        "compile arm", "status arm", "menu arm", "explain arm", "report arm", "diff arm", "check arm",
        "apply compiled/arm/manifest.yaml --yes", "watch arm --once --yes", "logs arm", DOWN,
    )  # fmt: skip
    assert {line.partition(" ")[0] for line in lines} == set(ENDS)
    try:
        for line in lines:
            ended = nameless(tmp_path, line)
            assert ended.returncode == 0, f"{line}: {ended.stdout}{ended.stderr}"
    finally:
        nameless(tmp_path, DOWN)
    assert not (tmp_path / "~").exists()
