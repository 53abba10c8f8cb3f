"""Nodes that overlap, nest, batch, fork, raise or end requests elsewhere: measured right, or refused with the cause.

Each reports by a metric how long its requests took by its own clock, read within what the probe times.
"""

import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fogspec.backends.protocol import SampleStatus
from fogspec.bench.record import make_record
from fogspec.results.requests import RecordRules, parse_requests
from fogspec.results.schema import Measured
from tests.support.agent import AGENT
from tests.unit.bench.test_record import SAMPLE

UNDER_WAY = "requests that were under way for longer than any other, and count with that: 1"
RULES = RecordRules(warmup=1, valid=0.9, statistic="mean", callback="plan")
NODE = """
import asyncio, multiprocessing, os, sys, time
from concurrent.futures import ThreadPoolExecutor
import fogspec_probe as probe
now = time.monotonic
"""
TASKS = """
async def plan(work_s):
    probe.start("plan"); t = now()
    await asyncio.sleep(work_s)
    probe.stop("plan", own_s=now() - t)
async def main():
    while True:
"""
RIGHT = {
    "overlapping tasks": TASKS
    + "        asyncio.create_task(plan(.05)); await asyncio.sleep(.025)\nasyncio.run(main())",
    "bursts": TASKS + "        await asyncio.gather(*(plan(.02 * k) for k in (1, 2, 3, 4)))\nasyncio.run(main())",
    "blocks in tasks": """
async def plan():
    with probe.request("plan") as told:
        t = now(); await asyncio.sleep(.05); told["own_s"] = now() - t
async def main():
    while True: asyncio.create_task(plan()); await asyncio.sleep(.025)
asyncio.run(main())
""",
    "nested": """
def plan(work_s, depth):
    probe.start("plan"); t = now()
    time.sleep(work_s)
    for _ in range(depth): plan(.005, 0)
    probe.stop("plan", own_s=now() - t)
while True: plan(.05, 2)
""",
    "a pool's thread": """
pool = ThreadPoolExecutor(1)
def miss(t): time.sleep(.05); probe.stop("plan", own_s=now() - t)
while True:
    for late in (False, True):
        probe.start("plan"); t = now()
        pool.submit(miss, t).result() if late else probe.stop("plan", own_s=now() - t)
""",
    "a function that raises now and then": """
def plan(i):
    probe.start("plan"); t = now()
    time.sleep(.005)
    if i == 9: raise RuntimeError("no path")
    probe.stop("plan", own_s=now() - t)
for i in range(10**9):
    try: plan(i)
    except RuntimeError: pass
""",
    "a handle for each of a batch": """
while True:
    batch = []
    for _ in range(4): batch.append((probe.start("plan"), now())); time.sleep(.01)
    for one, t in batch: one.stop(own_s=now() - t)
""",
    "processes of a pool": """
def plan(_): probe.start("plan"); t = now(); time.sleep(.03); probe.stop("plan", own_s=now() - t)
with multiprocessing.get_context("fork").Pool(2) as pool:
    while True: pool.map(plan, range(8), chunksize=1)
""",
}
REFUSED = {
    "raises": (
        """
i = 0
while True:
    i += 1
    try:
        probe.start("plan")
        if i % 3 == 0: time.sleep(.002); raise RuntimeError("no path")
        time.sleep(.02); probe.stop("plan")
    except RuntimeError: pass
""",
        "check",
        "requests were started and never ended",
    ),
    "one stop for four starts": (
        """
while True:
    for _ in range(4): probe.start("plan"); time.sleep(.01)
    probe.stop("plan")
""",
        "check",
        "requests were started and never ended",
    ),
    "two threads that end each other's": (
        """
with ThreadPoolExecutor(2) as pool:
    while True:
        probe.start("plan"); time.sleep(.01); probe.stop("plan")
        for _ in range(2): probe.start("plan")
        for _ in range(2): pool.submit(probe.stop, "plan").result()
""",
        "check",
        "keep what start('plan') returns, and call its stop()",
    ),
    "a queue": (
        """
def begin(): probe.start("plan")
def end(): probe.stop("plan")
begin()
while True: begin(); time.sleep(.01); end()
""",
        "not_reported",
        "ended while another was open in the same place, and which of them ended is not known",
    ),
    "a batch and as many ends": (
        """
def begin(): probe.start("plan"); time.sleep(.01)
def end(): probe.stop("plan")
while True:
    for _ in range(3): begin()
    for _ in range(3): end()
""",
        "not_reported",
        "while another was open in the same place, and which of them ended is not known",
    ),
    "a forked process ends it too": (
        """
while True:
    probe.start("plan")
    if os.fork() == 0: time.sleep(.05); probe.stop("plan"); os._exit(0)
    time.sleep(.01); probe.stop("plan"); os.wait()
""",
        "not_reported",
        "stopped in another process than that of its start",
    ),
}


def measured(folder: Path, *scripts: str, steps: int = 48, warmup: int = 1) -> Measured:
    """The record of a sample of these nodes by the agent."""
    words = [sys.executable, str(AGENT), "sample", "--out", str(folder / "out"), "--callback", "plan"]
    words += ["--steps", str(steps), "--warmup", str(warmup), "--after", "600", "--startup", "600"]
    for script in scripts:
        words += ["--process", json.dumps([sys.executable, "-c", NODE + script])]
    subprocess.run(words, timeout=1200, capture_output=True)
    outcome = json.loads((folder / "out" / "outcome.json").read_text())
    assert outcome["state"] == "ok", outcome["detail"]
    status = SampleStatus(running=False, timings=folder / "out" / "timings.jsonl", stopped_by=outcome["stopped_by"])
    return make_record(SAMPLE, status, replace(RULES, warmup=warmup), 1.0, 0.0)


@pytest.mark.parametrize("how", RIGHT)
def test_it_is_measured_right(tmp_path, how):
    made = measured(tmp_path, RIGHT[how])
    # On a busy computer a request may be under way for longer than any other.
    said = {"", UNDER_WAY, *(["requests that were started and never ended: 1"] if "raises" in how else ())}
    assert (made.state, made.unmatched, (made.detail or "") in said) == ("ok", None, True), made.detail
    assert made.requests >= 40
    for text in (tmp_path / "out" / "timings.jsonl").read_text().splitlines():
        line = json.loads(text)
        assert "open" in line or line["latency_s"] >= line["metrics"]["own_s"]


@pytest.mark.parametrize("how", REFUSED)
def test_it_is_refused_with_the_cause(tmp_path, how):
    script, reason, cause = REFUSED[how]
    made = measured(tmp_path, script)
    assert (made.state, made.reason) == ("failed", reason)
    assert cause in str(made.detail)


def test_each_process_has_a_warm_up_of_its_own(tmp_path):
    cold = """
def plan(_):
    probe.start("plan")
    kind = "warm" if globals().get("loaded") else "cold"
    globals()["loaded"] = True
    time.sleep(.02)
    probe.stop("plan", reason=kind)
with multiprocessing.get_context("fork").Pool(4) as pool:
    while True: pool.map(plan, range(8), chunksize=1)
"""
    measured(tmp_path, cold, steps=12, warmup=2)
    found = parse_requests(io.BytesIO((tmp_path / "out" / "timings.jsonl").read_bytes()), replace(RULES, warmup=2))
    assert len(found.latencies_s) >= 12
    kinds = [one.reason for one in found.finished]
    assert len(found.latencies_s) + found.cold == len(kinds)
    assert found.cold >= kinds.count("cold") + 1


def test_two_commands_that_time_one_name_are_said_with_their_means(tmp_path):
    node = 'while True: probe.start("plan"); time.sleep({}); probe.stop("plan"); open({!r}, "a").write("-")'
    here, slow = str(tmp_path / "fast"), str(tmp_path / "slow")
    waits = f"while not os.path.exists({slow!r}) or os.path.getsize({slow!r}) < 3: time.sleep(.01)\n"
    made = measured(tmp_path, waits + node.format(0.005, here), node.format(0.05, slow))
    assert made.state == "ok"
    assert str(made.detail).startswith("2 commands time one name, on average ")
    assert "none in 0" not in str(made.detail)
