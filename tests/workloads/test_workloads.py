"""The workloads of specs/: real work, checked; a request that fails its check is a failed request, never a fast one."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PLANNER = ROOT / "specs" / "cubicles-planner" / "planner.py"


def begin(tmp_path: Path, program: Path, *words: str) -> subprocess.Popen:
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT / "fogspec" / "agent"),
        "FOGSPEC_TIMINGS": str(tmp_path / "timings"),
    }
    return subprocess.Popen([sys.executable, str(program), *words], env=environment, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, start_new_session=True)  # fmt: skip


def run(tmp_path: Path, program: Path, *words: str) -> list[dict]:
    (tmp_path / "timings").unlink(missing_ok=True)
    started = begin(tmp_path, program, *words)
    _, said = started.communicate(timeout=600)
    assert (started.returncode, said) == (0, "")
    lines = map(json.loads, (tmp_path / "timings").read_text().splitlines())
    return [line for line in lines if "latency_s" in line]  # the first start of each name has a line too


def test_plans_have_a_path_at_least_as_long_as_the_straight_line_and_the_seed_decides(tmp_path):
    words = ("--samples", "3000", "--requests", "1")
    first, again = run(tmp_path, PLANNER, *words), run(tmp_path, PLANNER, *words)
    other = run(tmp_path, PLANNER, *words, "--seed", "8")
    lengths, repeated, others = ([r["metrics"]["path_length_m"] for r in found] for found in (first, again, other))
    assert all(record["ok"] for record in first)
    assert lengths == repeated
    assert lengths != others
    straight_m = (17**2 + 13**2) ** 0.5
    assert all(straight_m < length < 35 for length in lengths + others)


def test_no_path_is_a_failed_request(tmp_path):
    records = run(tmp_path, PLANNER, "--samples", "20", "--requests", "2")
    assert [(record["ok"], record["reason"], record["metrics"]) for record in records] == [(False, "no path", {})] * 2


def test_the_shortest_path_of_a_portfolio_counts_and_more_planners_are_no_worse(tmp_path):
    some, more = (
        [r["metrics"]["path_length_m"] for r in run(tmp_path, PLANNER, "--samples", "3000", "--requests", "2", *words)]
        for words in (("--planners", "2"), ("--planners", "3"))
    )
    assert all(after <= before for before, after in zip(some, more, strict=True))


def children(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def ignores_sigint(pid: str) -> bool:
    ignored = re.search(r"^SigIgn:\s*(\w+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    return ignored is not None and bool(int(ignored[1], 16) >> (signal.SIGINT - 1) & 1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_every_process_of_it_ends_it_quietly(tmp_path, number):
    # As its spec runs it. One plan alone searches in threads of scipy's, which a signal may end in the middle of their memory.
    started = begin(tmp_path, PLANNER, "--samples", "500", "--planners", "2")
    # A worker that was forked just now leaves SIGINT to its parent only once it has run its first lines.
    while not (tmp_path / "timings").exists() or not all(map(ignores_sigint, children(started.pid))):
        assert started.poll() is None
        time.sleep(0.01)
    if number == signal.SIGINT:  # what the agent sends to every process; TERM comes to the first alone, from a shell
        os.killpg(started.pid, number)
    else:
        started.terminate()
    _, said = started.communicate(timeout=600)
    assert (started.returncode, said) == (0, "")
