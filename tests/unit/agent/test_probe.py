"""The callback probe: whole lines from every thread and process, and nothing at all unless fogspec is measuring."""

import asyncio
import json
import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fogspec.agent import fogspec_probe as probe


@pytest.fixture
def timings(tmp_path, monkeypatch) -> Path:
    path = tmp_path / "timings.jsonl"
    monkeypatch.setenv("FOGSPEC_TIMINGS", str(path))
    probe._begin_process()
    probe._here.set(())
    return path


def records(path: Path) -> list[dict]:
    """The records of requests that ended, without those of their starts and of ends without one."""
    return [one for one in lines(path) if "latency_s" in one]


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def strays(path: Path) -> list[str]:
    """Why ends have no start."""
    return [one["reason"] for one in lines(path) if "unmatched" in one]


def test_one_request_is_one_line(timings):
    probe.start("plan")
    probe.stop("plan", ok=False, reason='no "path"\n', length_m=3)
    (record,) = records(timings)
    assert record.pop("start_s") > 0
    assert 0 <= record.pop("latency_s") < 600
    assert record.pop("process") == lines(timings)[0]["process"]
    assert record == {"name": "plan", "number": 1, "ok": False, "reason": 'no "path"\n', "metrics": {"length_m": 3.0}}


def test_each_start_is_a_line_with_its_number_and_command(timings, monkeypatch):
    monkeypatch.setenv("FOGSPEC_COMMAND", 'the "planner"')
    for name in ("plan", "track", "plan"):
        probe.start(name)
    found = lines(timings)
    assert [(one["open"], one["number"]) for one in found] == [("plan", 1), ("track", 1), ("plan", 2)]
    assert len({one["process"] for one in found}) == 1
    assert {one["command"] for one in found} == {'the "planner"'}
    assert found[0]["start_s"] <= found[2]["start_s"]


def test_nothing_happens_unless_measured(tmp_path, monkeypatch):
    monkeypatch.delenv("FOGSPEC_TIMINGS", raising=False)
    monkeypatch.chdir(tmp_path)
    probe.start("plan")
    probe.stop("plan", length_m="no number")
    probe.start("plan").stop(length_m="no number")
    with probe.request("plan"):
        pass
    assert list(tmp_path.iterdir()) == []


def on_another_thread(work, *arguments) -> None:
    other = threading.Thread(target=work, args=arguments)
    other.start()
    other.join()


def test_a_stop_elsewhere_ends_the_only_open_request_of_its_name(timings):
    probe.start("plan")
    probe.start("track")
    on_another_thread(probe.stop, "plan")
    assert [one["name"] for one in records(timings)] == ["plan"]
    probe.stop("plan")
    assert strays(timings) == ["stopped where none was started, while 0 were open in its process"]


def test_a_stop_elsewhere_does_not_guess_between_two(timings):
    def start_and_wait() -> None:
        probe.start("plan")

    probe.start("plan")
    on_another_thread(start_and_wait)
    on_another_thread(probe.stop, "plan")
    assert records(timings) == []
    assert strays(timings) == ["stopped where none was started, while 2 were open in its process"]


def test_what_start_returned_is_ended_by_any_thread(timings):
    first, second = probe.start("plan"), probe.start("plan")
    on_another_thread(first.stop)
    on_another_thread(second.stop, False, "no path")
    assert [(one["number"], one["ok"]) for one in records(timings)] == [(1, True), (2, False)]
    second.stop()
    assert strays(timings) == ["stopped for the second time"]
    assert not any("above" in one for one in lines(timings))


def test_tasks_that_overlap_end_their_own_requests(timings):
    async def plan(number: int) -> None:
        probe.start("plan")
        await asyncio.sleep(0.001 * (5 - number))
        probe.stop("plan", task=number)

    async def several() -> None:
        await asyncio.gather(*map(plan, range(5)))

    asyncio.run(several())
    assert {one["number"]: one["metrics"]["task"] for one in records(timings)} == {n + 1: n for n in range(5)}
    assert strays(timings) == []


def test_coroutines_of_one_thread_without_tasks_end_their_own_requests(timings):
    """As the executors of rclpy run them."""

    def callback(number: int):
        probe.start("plan")
        yield
        probe.stop("plan", callback=number)

    both = [callback(1), callback(2)]
    for one in (*both, *both):
        next(one, None)
    assert [(one["number"], one["metrics"]["callback"]) for one in records(timings)] == [(1, 1), (2, 2)]
    assert not any("above" in one for one in lines(timings))


def test_a_thread_of_a_task_ends_its_request(timings):
    async def plan(pool: ThreadPoolExecutor) -> None:
        probe.start("plan")
        await asyncio.to_thread(probe.stop, "plan")

    async def two() -> None:
        with ThreadPoolExecutor(2) as pool:
            await asyncio.gather(plan(pool), plan(pool))

    asyncio.run(two())
    assert {one["number"] for one in records(timings)} == {1, 2}
    assert strays(timings) == []


def test_a_function_that_calls_itself_ends_its_own_request(timings):
    def plan(depth: int) -> None:
        probe.start("plan")
        if depth:
            plan(depth - 1)
        probe.stop("plan", depth=depth)

    plan(2)
    assert {one["number"]: one["metrics"]["depth"] for one in records(timings)} == {1: 2, 2: 1, 3: 0}
    assert not any("above" in one for one in lines(timings))


def test_an_end_that_may_be_of_several_says_so(timings):
    def begin() -> None:
        probe.start("plan")

    begin()
    begin()
    probe.stop("plan")
    probe.stop("plan")
    assert [(one["number"], one.get("above")) for one in records(timings)] == [(2, 1), (1, None)]


def test_a_request_that_never_ends_does_not_grow_what_is_kept(timings):
    for _ in range(probe.MOST_OPEN + 50):
        probe.start("plan")
    probe.stop("plan")
    (ended,) = records(timings)
    assert ended["number"] == probe.MOST_OPEN + 50
    assert len(probe._here.get()) < probe.MOST_HERE
    assert len(probe._open["plan"]) < probe.MOST_OPEN


def test_a_forked_process_cannot_end_the_request_of_its_parent(timings):
    probe.start("plan")
    child = multiprocessing.get_context("fork").Process(target=probe.stop, args=("plan",))
    child.start()
    child.join()
    probe.stop("plan")
    assert strays(timings) == ["stopped in another process than that of its start"]
    (ended,) = records(timings)
    (stray,) = [one for one in lines(timings) if "unmatched" in one]
    assert ended["process"] != stray["process"]


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
    assert len(lines(timings)) == 2 * len(found)
    for name in {record["name"] for record in found}:
        assert [r["metrics"]["i"] for r in found if r["name"] == name] == list(range(300))
