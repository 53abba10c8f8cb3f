"""The bundled workloads: real work that checks its own answers, on as many CPUs as it is given."""

import importlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fogspec.agent
from fogspec.results.requests import RecordRules, read_requests
from tests.conftest import ROOT

WORKLOADS = ROOT / "specs" / "cubicles-planner"
PROBE = Path(next(iter(fogspec.agent.__path__)))


@pytest.fixture(scope="module")
def modules():
    """The workloads as modules, with the probe beside them as on a sampled machine."""
    before = list(sys.path)
    sys.path[:0] = [str(WORKLOADS), str(PROBE)]
    try:
        yield {"planner": importlib.import_module("planner")}
    finally:
        sys.path[:] = before


def run(tmp_path, name, *words, cpus=None):
    """Three requests in a process of its own; returns the records of those that ended."""
    timings = tmp_path / f"{name}-{cpus}.jsonl"
    chosen = set(sorted(os.sched_getaffinity(0))[:cpus])
    ended = subprocess.run(
        [sys.executable, str(WORKLOADS / f"{name}.py"), "--requests", "3", *words], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(PROBE), "FOGSPEC_TIMINGS": str(timings)}, timeout=600,
        preexec_fn=lambda: os.sched_setaffinity(0, chosen),
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    said = read_requests(timings, RecordRules(warmup=0, valid=0.9, statistic="mean"))
    assert said.unreadable == 0
    return [one for line in timings.read_text().splitlines() if "latency_s" in (one := json.loads(line))]


@pytest.mark.slow
def test_the_planner_finds_the_same_path_on_one_cpu_and_on_two(tmp_path, modules):
    lengths = []
    for cpus in (1, 2):
        if cpus > len(os.sched_getaffinity(0)):
            pytest.skip("this host has one CPU")
        lines = run(tmp_path, "planner", "--samples", "3000", cpus=cpus)
        assert [line["name"] for line in lines] == ["plan"] * 3
        lengths.append([line["metrics"].get("path_length_m") for line in lines])
    assert lengths[0] == pytest.approx(lengths[1])
    straight = math.dist(modules["planner"].START[:3], modules["planner"].GOAL[:3])
    assert all(straight < length < 3 * straight for length in lengths[0])
    assert len(set(lengths[0])) == 3, "every request is a roadmap of its own"


def test_what_touches_a_wall_is_not_free(modules):
    planner = modules["planner"]
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    poses = np.array([[*at, *upright] for at in ((1.5, 1.5, 1.5), (5.1, 0.5, 1.5), (0.5, 1.5, 1.5), (1.5, 1.5, 2.9))])
    assert planner.free(poses).tolist() == [True, False, False, False]
    through = np.stack([planner.START, np.array([9.0, 1.0, 1.5, *upright])])[None]
    assert planner.edges_free(through).tolist() == [False]
