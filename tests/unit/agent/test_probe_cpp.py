"""The C++ callback probe writes what the Python one writes, compiled with the warnings of a strict project."""

import json
import math
import shutil
import subprocess
from pathlib import Path

import pytest

from fogspec.agent import fogspec_probe

HEADER = Path(fogspec_probe.__file__).parent
PROGRAM = r"""
#include "fogspec_probe.hpp"
#include <thread>
#include <vector>
int main(int argc, char**) {
  if (argc > 1) {
    fogspec_probe::start("bad");
    try {
      fogspec_probe::stop("bad", true, "", {{"length", std::nan("")}});
      return 0;
    } catch (const std::invalid_argument&) {
      return 3;
    }
  }
  fogspec_probe::start("plan");
  fogspec_probe::stop("plan", false, "no \"path\"\n", {{"length_m", 3}, {"tries", 2.5}}, "narrow");
  fogspec_probe::stop("never started");
  try { fogspec_probe::Request one("block"); one.metrics["x"] = 1; throw 1; } catch (int) {}
  { fogspec_probe::Request one("block"); }
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; i++) threads.emplace_back([i] {
    const std::string name = "t" + std::to_string(i);
    for (int k = 0; k < 200; k++) { fogspec_probe::start(name); fogspec_probe::stop(name); }
  });
  for (auto& one : threads) one.join();
}
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    if shutil.which("g++") is None:
        pytest.skip("needs g++: apt-get install g++")
    folder = tmp_path_factory.mktemp("cpp")
    (folder / "program.cpp").write_text(PROGRAM)
    words = ["g++", "-std=c++17", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-pthread", f"-I{HEADER}"]
    subprocess.run([*words, str(folder / "program.cpp"), "-o", str(folder / "program")], check=True, timeout=600)
    return folder / "program"


def test_the_records_are_those_of_the_python_probe(program, tmp_path):
    timings = tmp_path / "timings.jsonl"
    subprocess.run([program], env={"FOGSPEC_TIMINGS": str(timings)}, check=True, timeout=600)
    lines = [json.loads(line) for line in timings.read_text().splitlines()]
    assert lines[0] == {"note": "'plan' was started and has not ended", "started": "plan"}
    assert sum("note" in one for one in lines) == 6
    records = [one for one in lines if "note" not in one]
    plan, thrown, block = records[:3]
    assert 0 < plan.pop("start_s") < math.inf
    assert 0 <= plan.pop("latency_s") < 600
    assert plan == {
        "name": "plan", "ok": False, "reason": 'no "path"\n', "metrics": {"length_m": 3.0, "tries": 2.5}, "scenario": "narrow",
    }  # fmt: skip
    assert (thrown["ok"], thrown["reason"], thrown["metrics"]) == (False, "exception", {"x": 1.0})
    assert (block["ok"], block["reason"]) == (True, None)
    assert {f"t{i}": 200 for i in range(4)} == {
        name: sum(one["name"] == name for one in records) for name in ("t0", "t1", "t2", "t3")
    }


def test_it_does_nothing_unless_measured(program, tmp_path):
    subprocess.run([program], env={}, cwd=tmp_path, check=True, timeout=600)
    assert list(tmp_path.iterdir()) == []


def test_a_metric_that_is_no_number_is_not_swallowed(program, tmp_path):
    ended = subprocess.run([program, "bad"], env={"FOGSPEC_TIMINGS": str(tmp_path / "t")}, timeout=600)
    assert ended.returncode == 3


def test_both_clocks_are_the_same(program, tmp_path):
    before = fogspec_probe.time.monotonic()
    subprocess.run([program], env={"FOGSPEC_TIMINGS": str(tmp_path / "t")}, check=True, timeout=600)
    lines = [json.loads(line) for line in (tmp_path / "t").read_text().splitlines()]
    starts_s = [one["start_s"] for one in lines if "note" not in one]
    assert len(starts_s) == 803
    assert all(before < start_s < fogspec_probe.time.monotonic() for start_s in starts_s)
