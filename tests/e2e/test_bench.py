"""`fogspec bench --runner local` as a user runs it: what is measured is measured once, whatever happens in between."""

import gzip
import hashlib
import json
import os
import signal
import statistics
from contextlib import nullcontext

import pytest

from fogspec.backends.local.backend import LocalSamples
from fogspec.base.errors import OutOfDate
from fogspec.bench.prepare import prepare
from fogspec.bench.run import bench
from fogspec.spec.loader import load
from tests.support.scenes import HALTING, SPEC, WORK, Scene, environments, tree, until

FIRST, SECOND = "local-1cpu-1gib", "local-2cpu-1gib"


@pytest.fixture
def halting(tmp_path, monkeypatch):
    """A bench that is in the middle of its first sample and stays there, in a shell that knows too much."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("SOME_API_KEY", "not for workloads")
    scene = Scene.made(tmp_path / "scene", HALTING, SPEC.replace("duration: 1min", "duration: 10min"))
    bench = scene.begin()
    until(lambda: scene.requests() >= 3)
    yield scene, bench
    if bench.poll() is None:
        bench.kill()
    bench.communicate()
    for pid in scene.alive():
        os.kill(pid, signal.SIGKILL)


def test_every_sample_is_measured_once(tmp_path):
    scene = Scene.made(tmp_path / "scene")
    ended = scene.bench()
    assert ended.returncode == 0, ended.stderr
    records = scene.records()
    assert list(records) == [FIRST, SECOND]
    for record in records.values():
        assert (record["state"], record["failed_requests"]) == ("ok", 0)
        assert record["requests"] >= 10
        kept = (scene.results.parent / record["timings"]["path"]).read_bytes()
        assert record["timings"]["digest"] == f"sha256:{hashlib.sha256(kept).hexdigest()}"
        _warmup, *latencies_s = [
            one["latency_s"] for one in map(json.loads, gzip.decompress(kept).splitlines()) if "latency_s" in one
        ]
        assert len(latencies_s) == record["requests"]
        mean_ms = float(record["latency"]["mean"].removesuffix("ms"))
        assert mean_ms == pytest.approx(1000 * statistics.fmean(latencies_s))
        assert mean_ms >= 10
    before = scene.results.read_bytes()
    again_by = before.decode().splitlines()[0].partition("Make it again: fogspec ")[2]
    assert again_by == "bench specs/tiny.yaml --runner local"
    again = scene.bench()
    assert (again.returncode, scene.started(), scene.results.read_bytes()) == (0, [FIRST, SECOND], before)
    assert "0 of 2 samples to measure" in again.stderr
    once_more = scene.bench("--only", SECOND)
    assert (once_more.returncode, scene.started()) == (0, [FIRST, SECOND, SECOND])
    assert scene.records()[FIRST] == records[FIRST]
    assert scene.records()[SECOND] != records[SECOND]
    assert scene.alive() == []
    assert scene.run("compile").returncode == 0
    assert (scene.folder / "compiled" / "tiny" / "manifest.yaml").exists()


def test_dry_run_and_wrong_words_measure_nothing(tmp_path):
    scene = Scene.made(tmp_path / "scene")
    assert scene.bench("--dry-run").returncode == 0
    unknown = scene.bench("--only", "no-such")
    assert (unknown.returncode, FIRST in unknown.stderr) == (2, True)
    assert scene.bench("--from", "x.yaml").returncode == 2
    assert scene.run("bench", "--runner", "replay").returncode == 2
    assert scene.run("bench", "--runner", "sky").returncode == 2
    assert (scene.started(), scene.records()) == ([], {})


def test_events_are_json_lines_and_the_last_one_is_the_results(tmp_path):
    scene = Scene.made(tmp_path / "scene")
    lines = [json.loads(line) for line in scene.bench("--only", FIRST, "-o", "json").stdout.splitlines()]
    assert lines[0]["event"] == "starts"
    assert lines[-2]["record"]["id"] == FIRST
    assert lines[-2]["record"]["stopped_by"] == "steps"
    assert lines[-1]["kind"] == "Results"


def test_the_logs_of_what_failed_are_kept_and_named(tmp_path):
    scene = Scene.made(tmp_path / "scene", "print('no luck today', flush=True)\nraise SystemExit(3)\n")
    ended = scene.bench("--only", FIRST)
    assert ended.returncode == 1
    named = ended.stdout.partition("logs: ")[2].splitlines()[0]
    assert f"logs: {named}" in ended.stderr
    logs = [path.read_text() for path in (scene.folder / named).rglob("*.log")]
    assert any("no luck today" in text for text in logs)


def test_a_bench_that_was_killed_goes_on(halting):
    scene, bench = halting
    name = scene.names()[0]
    bench.kill()
    bench.wait()
    assert scene.records() == {}
    assert scene.alive(), "the sample outlives its controller"
    (scene.folder / "specs" / "go").touch()
    ended = scene.bench()
    assert ended.returncode == 0, ended.stderr
    records = scene.records()
    assert {record["state"] for record in records.values()} == {"ok"}
    # The sample that went on was not started again: its three requests from before the kill count.
    assert (scene.names()[0], scene.started()) == (name, [FIRST, SECOND])
    assert scene.alive() == []


def test_what_ended_after_its_controller_was_killed_is_fetched(halting):
    scene, bench = halting
    bench.kill()
    bench.wait()
    (scene.folder / "specs" / "go").touch()
    until(lambda: not scene.alive())
    assert scene.bench().returncode == 0
    assert (scene.records()[FIRST]["state"], scene.started()) == ("ok", [FIRST, SECOND])


def test_a_sample_that_died_with_its_controller_is_measured_again(halting):
    scene, bench = halting
    bench.kill()
    bench.wait()
    for pid in scene.alive():
        os.kill(pid, signal.SIGKILL)
    (scene.folder / "specs" / "go").touch()
    assert scene.bench("--only", FIRST).returncode == 0
    assert (scene.records()[FIRST]["state"], scene.started()) == ("ok", [FIRST, FIRST])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_asked_to_stop_it_stops_cleanly(halting, number):
    scene, bench = halting
    bench.send_signal(number)
    _, said = bench.communicate(timeout=240)
    assert bench.returncode == 130
    assert "Traceback" not in said
    record = scene.records()[FIRST]
    assert (record["state"], record["reason"]) == ("failed", "interrupted")
    assert (scene.alive(), scene.started()) == ([], [FIRST])
    (scene.folder / "specs" / "go").touch()
    assert scene.bench().returncode == 0
    assert {one["state"] for one in scene.records().values()} == {"ok"}
    assert scene.started() == [FIRST, FIRST, SECOND]


def test_asked_twice_it_stops_at_once_and_the_next_one_cleans_up(halting):
    scene, bench = halting
    bench.send_signal(signal.SIGINT)
    bench.send_signal(signal.SIGINT)
    _, said = bench.communicate(timeout=240)
    assert (bench.returncode, "Traceback" in said) == (130, False)
    assert "fogspec down tiny tears" in said
    if scene.alive():
        assert f"may still run: {scene.names()[0]}" in said
    (scene.folder / "specs" / "go").touch()
    assert scene.bench().returncode == 0
    assert {one["state"] for one in scene.records().values()} == {"ok"}
    assert scene.alive() == []


def test_machines_whose_journal_is_lost_are_found_and_taken_down(halting):
    """As after a kill on another host: only the machines' names tell whose they are."""
    scene, bench = halting
    name = scene.names()[0]
    bench.kill()
    bench.wait()
    mark = f"FOGSPEC_JOB={name}@".encode()
    (scene.folder / ".fogspec" / "tiny" / "journal.jsonl").unlink()
    careful = scene.bench()
    assert (careful.returncode, name in careful.stderr, "--resume" in careful.stderr) == (8, True, True)
    assert scene.started() == []
    (scene.folder / "specs" / "go").touch()
    ended = scene.bench("--resume")
    assert ended.returncode == 0, ended.stderr
    assert not [pid for pid, words in environments() if any(word.startswith(mark) for word in words)]
    assert {one["state"] for one in scene.records().values()} == {"ok"}
    assert scene.alive() == []


def test_two_benches_at_once_are_one_too_many(halting):
    scene, bench = halting
    second = scene.bench()
    assert second.returncode == 8
    assert f"process {bench.pid}" in second.stderr
    assert (scene.started(), bench.poll()) == ([FIRST], None)


def test_what_another_bench_measured_meanwhile_is_not_lost(tmp_path):
    scene = Scene.made(tmp_path / "scene")
    application = load([scene.spec])[0].application
    prepared = prepare(application, scene.spec, [])
    assert scene.bench("--only", FIRST).returncode == 0
    before = scene.results.read_bytes()
    with pytest.raises(OutOfDate, match="has changed since this bench began"):
        bench(prepared, LocalSamples(), lambda _campaign: nullcontext(lambda _event: None))
    assert scene.results.read_bytes() == before


def test_the_shells_credentials_and_thread_counts_stay_out_of_a_sample(halting):
    scene, _ = halting
    seen = [words for pid, words in environments() if pid in scene.alive()]
    assert seen
    assert not [word for words in seen for word in words if word.startswith((b"OMP_NUM", b"SOME_API"))]


def test_only_requests_of_the_specs_callback_count(tmp_path):
    inner = "    for _ in range(4):\n        fogspec_probe.start('inner')\n        fogspec_probe.stop('inner')\n"
    scene = Scene.made(tmp_path / "scene", WORK.replace("    time.sleep(0.01)\n", "    time.sleep(0.01)\n" + inner))
    assert scene.bench("--only", FIRST).returncode == 0
    assert scene.records()[FIRST]["requests"] >= 10


def test_nothing_that_a_sample_started_outlives_it(tmp_path):
    work = (
        "import os, subprocess, sys, time\n"
        'subprocess.Popen([sys.executable, "-c", "import os, time; os.setsid(); time.sleep(60)"])\n'
        "if os.fork() == 0:\n    os.setsid()\n    time.sleep(60)\n"
        'import fogspec_probe\nfor _ in range(99):\n    fogspec_probe.start("work")\n    time.sleep(0.01)\n'
        '    fogspec_probe.stop("work")\ntime.sleep(60)\n'
    )
    scene = Scene.made(tmp_path / "scene", work)
    assert scene.bench("--only", FIRST).returncode == 0
    assert scene.alive() == []


def test_a_changed_spec_sets_aside_what_was_measured(tmp_path):
    scene = Scene.made(tmp_path / "scene")
    assert scene.bench("--only", FIRST).returncode == 0
    before = tree(scene.results.parent)
    scene.spec.write_text(SPEC.replace("work.py]", "work.py, --new]"))
    assert scene.run("compile").returncode == 0
    again = scene.bench("--only", SECOND)
    assert (again.returncode, "measured something else" in again.stderr) == (0, True)
    assert tree(scene.results.parent / "tiny.old-1") == before
    assert list(scene.records()) == [SECOND]


def test_measuring_again_and_stopping_keeps_what_was_measured(tmp_path):
    scene = Scene.made(tmp_path / "scene", HALTING, SPEC.replace("duration: 1min", "duration: 10min"))
    (scene.folder / "specs" / "go").touch()
    assert scene.bench("--only", FIRST).returncode == 0
    before = tree(scene.results.parent)
    (scene.folder / "specs" / "go").unlink()
    bench = scene.begin("--only", FIRST)
    until(lambda: len(scene.names()) == 2 and scene.requests() >= 3)
    bench.send_signal(signal.SIGINT)
    bench.communicate(timeout=240)
    assert (bench.returncode, scene.alive()) == (130, [])
    assert tree(scene.results.parent) == before


def test_every_document_of_a_spec_is_measured(tmp_path):
    scene = Scene.made(tmp_path / "scene", spec=f"{SPEC}---\n{SPEC.replace('name: tiny', 'name: second')}")
    assert scene.bench("--only", FIRST).returncode == 0
    second = scene.document(scene.folder / "results" / "second.yaml")
    assert [record["state"] for record in second["spec"]["samples"]] == ["ok"]
    assert [record["state"] for record in scene.records().values()] == ["ok"]


def test_a_request_that_the_end_breaks_off_did_not_fail(tmp_path):
    work = (
        "import sys, time, fogspec_probe\n"
        'while True:\n    with fogspec_probe.request("work"):\n        time.sleep(0.05)\n'
    )
    scene = Scene.made(tmp_path / "scene", work)
    assert scene.bench("--only", FIRST).returncode == 0
    record = scene.records()[FIRST]
    assert (record["state"], record["failed_requests"]) == ("ok", 0)


# Requests take what a list says, by a clock of the script's own, in the order of the list again and again.
SCRIPTED = """\
import itertools, time
import fogspec_probe

class Clock:
    now_s = 0.0

    def monotonic(self):
        return self.now_s

clock = fogspec_probe.time = Clock()
for took_s, scenario in itertools.cycle({requests}):
    fogspec_probe.start("work")
    time.sleep(0.01)
    clock.now_s += took_s
    fogspec_probe.stop("work", scenario=scenario)
"""


def test_scenarios_are_weighed_as_the_spec_says(tmp_path):
    """The workload sends one hard request in four, the spec says that half of them are."""
    spec = SPEC.replace("  benchmark:\n", "  benchmark:\n    scenarios: {easy: 1, hard: 1}\n")
    assert spec != SPEC
    requests = [(0.05, "hard"), (0.01, "easy"), (0.01, "easy"), (0.01, "easy")]
    scene = Scene.made(tmp_path / "scene", SCRIPTED.format(requests=requests), spec)
    ended = scene.bench("--only", FIRST)
    assert ended.returncode == 0, ended.stderr
    mean_ms = float(scene.records()[FIRST]["latency"]["mean"].removesuffix("ms"))
    assert mean_ms == pytest.approx(30)


def test_enough_requests_for_the_precision_asked_for_stop_a_sample(tmp_path):
    work = SCRIPTED.format(requests=[(0.004, None), (0.006, None), (0.008, None)])
    stop = "stop: {requests: 100000, duration: 2min, precision: 10%}"
    scene = Scene.made(tmp_path / "scene", work, SPEC.replace("stop: {requests: 10, duration: 1min}", stop))
    ended = scene.bench("--only", FIRST)
    assert ended.returncode == 0, ended.stderr
    record = scene.records()[FIRST]
    assert (record["state"], record["stopped_by"]) == ("ok", "precision")
    assert 10 <= record["requests"] < 1000
    assert "setup" in record
    assert "measuring" in record
