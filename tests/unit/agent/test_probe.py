"""The callback probe: whole lines from every thread and process, and nothing at all unless fogspec is measuring."""

import json
import multiprocessing
import threading
from pathlib import Path

import pytest

from fogspec.agent import fogspec_probe as probe


@pytest.fixture
def timings(tmp_path, monkeypatch) -> Path:
    path = tmp_path / "timings.jsonl"
    monkeypatch.setenv("FOGSPEC_TIMINGS", str(path))
    monkeypatch.setattr(probe, "_noted", set())
    return path


def records(path: Path) -> list[dict]:
    """The records without the notes of a name's first start."""
    found = [json.loads(line) for line in path.read_text().splitlines()]
    return [one for one in found if "note" not in one]


def test_one_request_is_one_line(timings):
    probe.start("plan")
    probe.stop("plan", ok=False, reason='no "path"\n', length_m=3)
    (record,) = records(timings)
    assert record.pop("start_s") > 0
    assert 0 <= record.pop("latency_s") < 600
    assert record == {"name": "plan", "ok": False, "reason": 'no "path"\n', "metrics": {"length_m": 3.0}}


def test_the_first_start_of_a_name_is_noted_once(timings):
    for _ in range(2):
        probe.start("plan")
    (note,) = [json.loads(line) for line in timings.read_text().splitlines()]
    assert note == {"note": "'plan' was started and has not ended", "started": "plan"}
    probe.stop("plan")


def test_nothing_happens_unless_measured(tmp_path, monkeypatch):
    monkeypatch.delenv("FOGSPEC_TIMINGS", raising=False)
    monkeypatch.chdir(tmp_path)
    probe.start("plan")
    probe.stop("plan", length_m="no number")
    with probe.request("plan"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_stop_without_a_start_of_that_name_on_that_thread_says_nothing(timings):
    probe.start("plan")
    other = threading.Thread(target=probe.stop, args=("plan",))
    other.start()
    other.join()
    probe.stop("track")
    assert records(timings) == []
    probe.stop("plan")
    probe.stop("plan")
    assert len(records(timings)) == 1


def test_requests_may_be_nested(timings):
    with probe.request("outer"), probe.request("inner"):
        pass
    inner, outer = records(timings)
    assert (inner["name"], outer["name"]) == ("inner", "outer")
    assert outer["start_s"] <= inner["start_s"]
    assert outer["latency_s"] >= inner["latency_s"]


def test_a_block_passes_on_what_it_was_told_and_fails_with_its_exception(timings):
    with probe.request("plan") as told:
        told |= {"ok": False, "reason": "no path", "tries": 4}
    with pytest.raises(KeyError), probe.request("plan") as told:
        told.pop("tries")
    first, second = records(timings)
    assert (first["ok"], first["reason"], first["metrics"]) == (False, "no path", {"tries": 4.0})
    assert (second["ok"], second["reason"]) == (False, "KeyError")


def test_a_metric_that_is_no_number_is_not_swallowed(timings):
    probe.start("plan")
    with pytest.raises(ValueError, match="long"):
        probe.stop("plan", length_m="long")


def many(name: str) -> None:
    for i in range(300):
        probe.start(name)
        probe.stop(name, i=i)


def test_threads_and_forked_processes_write_whole_lines(timings):
    fork = multiprocessing.get_context("fork")
    workers = [threading.Thread(target=many, args=(f"t{i}" * 200,)) for i in range(4)]
    workers += [fork.Process(target=many, args=(f"p{i}" * 200,)) for i in range(2)]
    for worker in reversed(workers):  # processes first: forking under threads is no subject of this test
        worker.start()
    for worker in workers:
        worker.join()
    found = records(timings)
    assert len(found) == 6 * 300
    for name in {record["name"] for record in found}:
        assert [r["metrics"]["i"] for r in found if r["name"] == name] == list(range(300))
