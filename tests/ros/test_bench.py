"""`fogspec bench` of specs with real ROS 2 nodes: each probe, the workload player, conditions, metrics and bad input."""

import itertools
import shutil
import statistics
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin

from tests.ros.benching import NODES, bench, node, truth
from tests.ros.namespaces import PYTHON, Net, undisturbed
from tests.unit.agent.test_bag import record

TOPICS = {"request": "/imu", "response": "/pose"}


def busy(net: Net, kind: str, *words: Any) -> list[dict[str, Any]]:
    return [node("busy", kind, 0.02, net.folder / "truth", *words)]


def milliseconds(text: str) -> float:
    assert text.endswith("ms"), text
    return float(text[:-2])


def close(net: Net, lines: list[dict[str, Any]], what: str) -> None:
    """The fastest request, which little else held up, took what the node was busy."""
    fastest_s = min(line[what] for line in lines if what in line)
    assert -0.002 < fastest_s - min(truth(net.folder / "truth")) < 0.015


def recorded(net: Net, folder: str = "drive") -> str:
    """A bag of requests beside the spec."""
    (net.folder / "specs").mkdir(exist_ok=True)
    record(net.folder / "specs" / folder, StoragePlugin.MCAP, count=6)
    return folder


@undisturbed
def test_a_service_with_the_user_s_client(net: Net) -> None:
    spec = {
        "cloud": busy(net, "service"), "probe": {"service": "plan"},
        "benchmark": {"workload": {"node": node("client", "service", 4000)}},
    }  # fmt: skip
    sample, lines = bench(net, spec)
    assert (sample["state"], sample["requests"] >= 25) == ("ok", True)
    assert milliseconds(sample["service"]["p50"]) > 19
    close(net, lines, "service_s")


@undisturbed
def test_recorded_calls_of_a_service_whose_answers_are_judged(net: Net) -> None:
    (net.folder / "specs").mkdir(exist_ok=True)
    calls = net.run([str(PYTHON), str(NODES / "calls.py"), str(net.folder / "specs" / "calls")], 600)
    assert calls.returncode == 0, calls.stderr
    spec = {
        "cloud": busy(net, "service", "--fail-every", 10), "probe": {"service": "/plan", "success": "success == true"},
        "benchmark": {"workload": {"bag": "calls"}, "min_success_rate": "80%"},
    }  # fmt: skip
    sample, lines = bench(net, spec)
    assert sample["state"] == "ok", sample
    assert 1 <= sample["failed_requests"] <= 4
    requests = sorted((line["start_s"], line["latency_s"]) for line in lines if "latency_s" in line)
    # Closed-loop: no call is sent before the one before it is answered.
    waits = [later_s - begun_s - latency_s for (begun_s, latency_s), (later_s, _) in itertools.pairwise(requests)]
    assert statistics.median(waits) >= -0.01


@undisturbed
def test_an_action_with_goals_that_fail(net: Net) -> None:
    spec = {
        "cloud": busy(net, "action", "--fail-every", 3), "probe": {"action": "/navigate"},
        "benchmark": {"workload": {"node": node("client", "action", 4000, "--watchers", 1)}},
    }  # fmt: skip
    sample, _ = bench(net, spec)
    assert (sample["state"], sample["reason"]) == ("failed", "check")
    assert "requests failed their check: the goal was aborted" in sample["detail"]


@undisturbed
def test_topics_from_a_bag_closed_loop_with_a_metric_and_a_condition(net: Net) -> None:
    spec = {
        "cloud": busy(net, "topic", "--fail-every", 20),
        "probe": {**TOPICS, "success": "pose.position.z == 1", "timeout": "5s"},
        "metrics": {"count": {"topic": "/pose", "field": "pose.position.x"}},
        "benchmark": {"workload": {"bag": recorded(net)}, "min_success_rate": "80%"},
    }  # fmt: skip
    sample, lines = bench(net, spec)
    assert sample["state"] == "ok", sample
    assert sample["requests"] + sample["failed_requests"] >= 23
    assert sample["failed_requests"] >= 1
    assert sample["metrics"]["count"] > 3
    requests = [line for line in lines if "latency_s" in line]
    # Closed-loop: no request is sent before the one before it is answered.
    waits = [other["start_s"] - one["start_s"] - one["latency_s"] for one, other in itertools.pairwise(requests)]
    assert statistics.median(waits) >= -0.01
    assert len({tuple(line["stamp"]) for line in requests}) == len(requests)


@undisturbed
def test_topics_from_a_bag_at_a_rate_inside_the_node(net: Net) -> None:
    spec = {
        "cloud": busy(net, "topic"), "probe": {**TOPICS, "via": "preload"},
        "benchmark": {"workload": {"bag": recorded(net), "rate": "8/s"}},
    }  # fmt: skip
    sample, lines = bench(net, spec)
    assert sample["state"] == "ok", sample
    starts = [line["start_s"] for line in lines if "latency_s" in line]
    gaps = [b - a for a, b in itertools.pairwise(starts)]
    assert statistics.median(gaps) == pytest.approx(1 / 8, abs=0.06)


@undisturbed
def test_a_bag_that_the_nodes_record_is_read_afterwards(net: Net) -> None:
    spec = {
        "cloud": busy(net, "topic"), "probe": {**TOPICS, "bag": "run"},
        "benchmark": {"workload": {"node": node("client", "topic", 4000, "--rate", 10)},
                      "stop": {"requests": 100, "duration": "30s"}},
    }  # fmt: skip
    # Beside the spec, in the copy that the sample has: the working folder of its nodes.
    words = ["run", "/imu=sensor_msgs/msg/Imu", "/pose=geometry_msgs/msg/PoseStamped"]
    spec["cloud"].append(node("recorder", *words))
    sample, _ = bench(net, spec)
    assert sample["state"] == "ok", sample
    assert sample["requests"] >= 10
    # A busy recorder writes down requests and responses late, each by another time.
    busy_ms = 1000 * statistics.median(truth(net.folder / "truth"))
    assert milliseconds(sample["latency"]["p50"]) == pytest.approx(busy_ms, abs=15)


@pytest.mark.parametrize("late_s", [0.05, 0.25, 0.45])
@undisturbed
def test_requests_without_stamps_are_paired_from_a_moment_when_none_is_under_way(net: Net, late_s: float) -> None:
    """At 10/s as many as four are under way when the listener joins, and a talker makes up for the time that it was held."""
    spec = {
        "cloud": [node("words", "answer", late_s)],
        "probe": {"request": "/words", "response": "/said", "match": "order"},
        "benchmark": {"workload": {"node": node("words", "talk", 10)}, "stop": {"requests": 40, "duration": "30s"}},
    }  # fmt: skip
    sample, lines = bench(net, spec)
    assert sample["state"] == "ok", sample
    assert sample["failed_requests"] == 0
    assert "unreadable" not in (sample.get("detail") or "")
    assert milliseconds(sample["latency"]["p50"]) == pytest.approx(1000 * late_s, abs=10)
    assert [line["hold"] for line in lines if "hold" in line] == [True, False, False]
    assert lines[-1] == {"hold": False, "ended": True}


@undisturbed
def test_requests_without_stamps_from_more_than_the_workload_are_refused(net: Net) -> None:
    spec = {
        "cloud": [node("words", "answer", 0.05), node("words", "talk", 10)],
        "probe": {"request": "/words", "response": "/said", "match": "order"},
        "benchmark": {"workload": {"node": node("words", "talk", 7)}, "stop": {"requests": 40, "duration": "30s"}},
    }  # fmt: skip
    sample, _ = bench(net, spec)
    assert (sample["state"], sample["reason"]) == ("failed", "not_reported")
    assert "requests on /words come while the workload is held, from others than it" in sample["detail"]


BAD: dict[str, tuple[dict[str, Any], str, str]] = {
    "a topic that never answers": (
        {"probe": TOPICS, "words": ["topic", "--silent"]}, "no_response", "on /imu, no response to them on /pose",
    ),
    "a topic that no node publishes": (
        {"probe": {**TOPICS, "response": "/nothing"}, "words": ["topic"]}, "no_response", "no node publishes /nothing",
    ),
    "a topic that is published by nearly this name": (
        {"probe": {**TOPICS, "response": "/poze"}, "words": ["topic"]}, "not_reported",
        "no node publishes /poze (there is /pose)",
    ),
    "a topic that a node only hears": (
        {"probe": {"request": "/pose", "response": "/imu_raw"}, "words": ["topic", "--hears", "/imu_raw"]}, "no_response",
        "no node publishes /imu_raw",
    ),
    "a type without a stamp": (
        {"probe": {"request": "/imu", "response": "/rosout"}, "words": ["topic"]}, "crash",
        "not begin with a std_msgs/Header",
    ),
    "a field that is not there": (
        {"probe": {**TOPICS, "success": "quality > 1"}, "words": ["topic"]}, "crash", "has no field quality",
    ),
    "a node that dies half-way": (
        {"probe": TOPICS, "words": ["topic", "--die-after", 9, "--watchers", 2]}, "crash", "the node gives up half-way",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_has_a_name_and_an_end(net: Net, name: str) -> None:
    change, reason, detail = BAD[name]
    kind, *more = change["words"]
    # What ends by itself may take as long as it takes; the others take all of this.
    patience = {"no_response": "20s", "not_reported": "120s"}.get(reason, "10min")
    spec = {
        "cloud": busy(net, kind, *more), "probe": change["probe"],
        "benchmark": {"workload": {"node": node("client", kind, 4000)}, "ready_timeout": patience,
                      "stop": {"duration": "10min"}},
    }  # fmt: skip
    sample, lines = bench(net, spec)
    assert (sample["state"], sample["reason"]) == ("failed", reason), sample
    assert detail in sample["detail"]
    if name == "a node that dies half-way":
        assert 1 <= len([line for line in lines if line.get("ok")]) <= 9


def test_a_bag_that_is_cut_off_is_played_up_to_the_cut(net: Net) -> None:
    folder = net.folder / "specs" / recorded(net)
    (file,) = folder.glob("*.mcap")
    shutil.copy(file, Path(net.folder / "specs" / "cut.mcap"))
    content = file.read_bytes()
    (net.folder / "specs" / "cut.mcap").write_bytes(content[: len(content) // 3])
    spec = {
        "cloud": busy(net, "topic"),
        "probe": TOPICS,
        "benchmark": {"workload": {"bag": "cut.mcap"}, "ready_timeout": "10min"},
    }
    sample, _ = bench(net, spec)
    assert (sample["state"], sample["reason"]) == ("failed", "crash"), sample
    assert "cut.mcap is damaged or cut off" in sample["detail"]
