"""Every figure that the docs quote: `make figures` prints them, `python -m tests.figures --write` writes some of them.

Commands are timed as whole processes, in turn with one that only imports pydantic and ruamel.yaml, by the processor time that
they take of user and kernel: other programs on the machine hardly disturb the least of many. Figures depend on the machine;
ratios to those imports are what to compare.
"""

import compileall
import contextlib
import io
import json
import os
import platform
import re
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from fogspec.base import child

ROOT = Path(__file__).resolve().parent.parent
PAPER_SPECS = ("grasp-planning-recorded", "vslam-recorded", "motion-planning-recorded")
RUNS = 15
BARE = "import ruamel.yaml; from pydantic import BaseModel"
QUOTED = (
    "machine:",
    "only imports",
    "validate specs/grasp",
    "compile specs/grasp",
    "fit and choose, 50,000",
    "choose again, 50,000",
    "install:",
)  # in how-good.md
BLOCK = re.compile(r"(<!-- python -m tests\.figures --write -->\n```text\n).*?(```\n)", re.DOTALL)


def main(write: bool) -> None:
    """Print one line a figure."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed if write else sys.stdout):
        _measure()
    if write:
        quoted = "".join(line for line in printed.getvalue().splitlines(keepends=True) if line.startswith(QUOTED))
        readme = ROOT / "docs" / "explanation" / "how-good.md"
        text = BLOCK.sub(lambda block: block[1] + quoted + block[2], readme.read_text("utf-8"))
        readme.write_text(text, "utf-8")
        print(quoted, end="")


def _measure() -> None:
    print(f"machine: {platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}")
    compileall.compile_dir(ROOT / "fogspec", quiet=1)
    with tempfile.TemporaryDirectory() as scratch:
        here = Path(scratch)
        for folder in ("specs", "results"):
            shutil.copytree(ROOT / folder, here / folder, ignore=shutil.ignore_patterns("planner*"))
        commands = {f"{verb} specs/{spec}.yaml": [*_fogspec(), verb, f"specs/{spec}.yaml"]
                    for spec in PAPER_SPECS for verb in ("validate", "compile")}  # fmt: skip
        _beside({f"only imports ({BARE})": [sys.executable, "-c", BARE], **commands}, here)
        print(_timed("validate 1,000 specs", [*_fogspec(), "validate", str(_many(here / "many"))], here, 3))
    _module("tests.bench_choice")
    _module("tests.bench_catalog")
    _module("tests.bench_runner")
    _install_size()


def _fogspec() -> list[str]:
    return [sys.executable, "-m", "fogspec"]


def _many(folder: Path) -> Path:
    """A thousand specs, each with a name of its own."""
    folder.mkdir()
    text = (ROOT / "specs/grasp-planning-recorded.yaml").read_text(encoding="utf-8")
    for number in range(1000):
        (folder / f"{number}.yaml").write_text(
            text.replace("name: grasp-planning", f"name: grasp-{number}"), encoding="utf-8"
        )
    return folder


def _beside(commands: Mapping[str, Sequence[str]], cwd: Path) -> None:
    """Print the processor time of each command; all of them run once, then again."""
    took: dict[str, list[float]] = {name: [] for name in commands}
    for run in range(RUNS + 1):
        for name, argv in commands.items():
            before = _children_s()
            _run(argv, cwd)
            if run:
                took[name].append(_children_s() - before)
    bare = min(next(iter(took.values())))
    for name, times in took.items():
        print(f"{name}: CPU time {min(times):.3f} s (median {statistics.median(times):.3f}, max {max(times):.3f}, "
              f"{RUNS} runs, whole process): {min(times) / bare:.1f} times the imports")  # fmt: skip


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _run(argv: Sequence[str], cwd: Path) -> None:
    done = subprocess.run(argv, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(argv)} ended with {done.returncode}:\n{done.stderr}")


def _timed(name: str, argv: Sequence[str], cwd: Path, runs: int) -> str:
    walls = []
    for run in range(runs + 1):
        start = time.perf_counter()
        _run(argv, cwd)
        if run:
            walls.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return (f"{name}: median {statistics.median(walls):.3f} s (min {min(walls):.3f}, max {max(walls):.3f}, "
            f"{runs} runs, whole process); largest process so far {peak:.0f} MiB")  # fmt: skip


def _module(name: str) -> None:
    # With one thread, as the commands set it for themselves.
    ended = subprocess.run([sys.executable, "-m", name], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True,
                           env=os.environ | {child.THREADS: "1"})  # fmt: skip
    print(ended.stdout, end="")


def _install_size() -> None:
    """Bytes of the installed packages of `requirements/run.lock`, and of SkyPilot's on top."""
    site = Path(sys.prefix)
    listing = json.loads(subprocess.run(
        [sys.executable, "-m", "pip", "inspect", "--local"], check=True, capture_output=True, text=True
    ).stdout)["installed"]  # fmt: skip
    sizes = {
        item["metadata"]["name"].lower().replace("_", "-").replace(".", "-"): _size(site, item) for item in listing
    }
    runtime = {line.split("==")[0].strip() for line in (ROOT / "requirements/run.lock").read_text().splitlines()
               if "==" in line and not line.startswith(" ")}  # fmt: skip
    known = [sizes.get(name.lower().replace("_", "-").replace(".", "-"), 0) for name in runtime]
    package = sum(
        f.stat().st_size for f in (ROOT / "fogspec").rglob("*") if f.is_file() and "__pycache__" not in f.parts
    )
    print(f"install: runtime packages {sum(known) / 1e6:.0f} MB, fogspec itself {package / 1e6:.1f} MB")


def _size(site: Path, item: dict[str, object]) -> int:
    record = Path(str(item["metadata_location"])) / "RECORD"
    if not record.is_file():
        return 0
    rows = (line.rsplit(",", 2) for line in record.read_text().splitlines())
    return sum(int(row[2]) for row in rows if len(row) == 3 and row[2].isdigit())


if __name__ == "__main__":
    main("--write" in sys.argv[1:])
