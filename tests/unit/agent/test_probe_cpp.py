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
#include <sys/wait.h>
#include <thread>
#include <vector>
int main(int argc, char** argv) {
  const std::string how = argc > 1 ? argv[1] : "";
  if (how == "account") {
    const auto one = fogspec_probe::start("plan"), two = fogspec_probe::start("plan");
    std::thread([&] { one.stop(); two.stop(false, "no path"); two.stop(); }).join();
    fogspec_probe::start("plan");
    std::thread([] { fogspec_probe::stop("plan"); }).join();
    fogspec_probe::start("plan");
    std::thread([] { fogspec_probe::start("plan"); }).join();
    std::thread([] { fogspec_probe::stop("plan"); }).join();
    if (fork() == 0) {
      fogspec_probe::stop("plan");
      fogspec_probe::start("plan");
      fogspec_probe::stop("plan");
      _exit(0);
    }
    wait(nullptr);
    fogspec_probe::start("plan");
    fogspec_probe::stop("plan");
    fogspec_probe::stop("plan");
    return 0;
  }
  if (how == "bad") {
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
    assert (lines[0]["open"], lines[0]["number"]) == ("plan", 1)
    assert sum("open" in one for one in lines) == 803
    records = [one for one in lines if "latency_s" in one]
    assert {(one["name"], one["number"]) for one in records} == {
        (one["open"], one["number"]) for one in lines if "open" in one
    }
    assert len({one["process"] for one in lines}) == 1
    plan, thrown, block = records[:3]
    assert lines[0]["start_s"] <= plan["start_s"]
    assert (plan.pop("process"), plan.pop("number")) == (lines[0]["process"], 1)
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


def test_the_account_is_that_of_the_python_probe(program, tmp_path):
    timings = tmp_path / "timings.jsonl"
    environment = {"FOGSPEC_TIMINGS": str(timings), "FOGSPEC_COMMAND": 'the "planner"'}
    subprocess.run([program, "account"], env=environment, check=True, timeout=600)
    lines = [json.loads(line) for line in timings.read_text().splitlines()]
    assert {one["command"] for one in lines if "open" in one} == {'the "planner"'}
    parent = lines[0]["process"]
    ended = [(one["process"] == parent, one["number"], one.get("above")) for one in lines if "latency_s" in one]
    assert ended == [(True, 1, None), (True, 2, None), (True, 3, None), (False, 1, None), (True, 6, 4), (True, 4, None)]
    assert [one["reason"] for one in lines if "unmatched" in one] == [
        "stopped for the second time",
        "stopped where none was started, while 2 were open in its process",
        "stopped in another process than that of its start",
    ]


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
    starts_s = [one["start_s"] for one in lines if "start_s" in one]
    assert len(starts_s) == 2 * 803
    assert all(before < start_s < fogspec_probe.time.monotonic() for start_s in starts_s)
