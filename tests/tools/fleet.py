"""CPU time of the gate over many applications: `python -m tests.tools.fleet FOLDER [APPLICATIONS]`.

Writes a repository of that many applications with lock, results, manifests and one commit (kept, if FOLDER has it already),
and prints wall and CPU seconds of each verb over all of them: with nothing changed, one, and all.
"""

import contextlib
import io
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

from fogspec.cli import main
from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from fogspec.results.schema import LatencySummary, Measured, ResultsBody
from tests.support.results import write

SPEC = """apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{name: {name}}}
spec:
  cloud:
    - cmd: [python3, work.py, "{number}"]
  probe: {{callback: plan}}
  constraints: {{latency: 4s, cost: $0.01/request}}
  objective: {{alpha: {alpha}}}
  hardware: {{cpus: 2..32, memory: 4GiB..128GiB}}
  infra: [aws/us-east-1]
  benchmark: {{budget: $5, sampler: grid, stop: {{requests: 20, duration: 1min}}, ready_timeout: 1min}}
"""
VERBS = (("check",), ("check", "--since", "HEAD"), ("status",), ("diff", "--since", "HEAD"))


def measure(name: str) -> None:
    """Write results for every sample of the plan, with latencies that follow from the machines."""
    path = Path("compiled", name, "plan.yaml")
    plan = read_document(path, Plan)
    body = plan.spec
    records = [
        Measured(
            id=one.id,
            machine=one.machine,
            measured_on="a test",
            state="ok",
            requests=20,
            duration=60.0,
            latency=LatencySummary(mean=0.5 + 4 / one.machine.cpus, sd=0.02),
            errors={"mean": 0.01},
            spent=one.machine.price / 60,
        )
        for one in body.samples
    ]
    write(Path("results", name), ResultsBody(inputs=body.inputs, runner="skypilot", samples=records))


def fogspec(*words: str) -> int:
    """Run a command in this process, silently; return its exit code."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            main(words)
        except SystemExit as ended:
            return int(ended.code or 0)
    return 0


def git(*words: str) -> None:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *who, *words], check=True, capture_output=True)


def make(applications: int) -> None:
    """Write the repository into the working directory."""
    names = [f"app{number:03}" for number in range(applications)]
    Path("results").mkdir()
    for number, name in enumerate(names):
        text = SPEC.format(name=name, number=number, alpha=0.2 + 0.6 * number / applications)
        folder = Path("specs", name)
        folder.mkdir(parents=True)
        (folder / "work.py").write_text("print('work')\n")
        (folder / f"{name}.yaml").write_text(text)
    for words in (("lock", "--catalog", "snapshot"), ("compile",)):
        assert fogspec(*words) == 0, words
    for name in names:
        measure(name)
    assert fogspec("compile") == 0
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "all")


def timed(what: str, *words: str) -> None:
    """Print exit code, wall and CPU seconds of a command in a process of its own."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    code = subprocess.run([sys.executable, "-m", "fogspec", *words], capture_output=True).returncode
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{what:<16} {' '.join(words):<18} exit {code}  wall {wall:6.1f} s  CPU {cpu:6.1f} s", flush=True)


def run(folder: str, applications: str = "300") -> None:
    """Make the repository if it is not there, and time the verbs."""
    there = Path(folder, ".git").exists()
    Path(folder).mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    if not there:
        make(int(applications))
    try:
        for what, changed in (("nothing changed", 0), ("one changed", 1), ("all changed", int(applications))):
            for number in range(changed):
                path = Path(f"specs/app{number:03}/app{number:03}.yaml")
                path.write_text(path.read_text().replace("latency: 4s", "latency: 3s"))
            for words in VERBS:
                timed(what, *words)
            git("checkout", "-q", "specs")
    finally:
        git("checkout", "-q", "specs")


if __name__ == "__main__":
    run(*sys.argv[1:])
