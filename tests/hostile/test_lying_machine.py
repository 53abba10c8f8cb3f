"""A machine that sends nonsense fails its own sample, and nothing else."""

from pathlib import Path

import pytest

from tests.support.scenes import Scene

HEAD = "import json, os, sys, time\nimport fogspec_probe\n"
SMALL, LARGE = "local-1cpu-1gib", "local-2cpu-1gib"
# The small machine lies; the other one works as it should.
LIES = """
path = os.environ["FOGSPEC_TIMINGS"]
def work():
    for _ in range(15):
        fogspec_probe.start("work"); time.sleep(0.01); fogspec_probe.stop("work")
if len(os.sched_getaffinity(0)) == 1:
    with open(path, "ab") as file:
        file.write(%r * %d)
work()
"""


@pytest.mark.slow
def test_a_latency_that_overflows_costs_one_sample_and_no_more(tmp_path: Path) -> None:
    line = b'{"name": "work", "latency_s": 1e200, "ok": true}\n'
    scene = Scene.made(tmp_path / "scene", HEAD + LIES % (line, 5))
    ended = scene.bench()
    assert ended.returncode == 0, ended.stderr
    records = scene.records()
    assert (records[SMALL]["state"], records[SMALL]["reason"]) == ("failed", "out_of_range")
    assert "latency_s is 1e+200s, and must be between 0s and 1e+06s" in records[SMALL]["detail"]
    assert (scene.results / "timings" / f"{SMALL}.jsonl.gz").is_file(), "the raw record is kept"
    assert records[LARGE]["state"] == "ok"
    assert scene.run("compile").returncode in (0, 4)
    assert scene.bench().returncode == 0
    assert scene.run("status").returncode == 0
