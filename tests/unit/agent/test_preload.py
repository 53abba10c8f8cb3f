"""The timing library in the process of a node that has no middleware: what it writes of requests, goals and topics."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fogspec.agent import preload
from fogspec.agent.matching import NOT_UNIQUE
from tests.tools.preload import build, cost_s, play, played

ACTION = {"FOGSPEC_PRELOAD_ACTION": "/go"}
TOPICS = {"FOGSPEC_PRELOAD_REQUEST": "/in", "FOGSPEC_PRELOAD_RESPONSE": "/out", "FOGSPEC_STAMPED": "1"}
ORDER = {"FOGSPEC_PRELOAD_REQUEST": "/in", "FOGSPEC_PRELOAD_RESPONSE": "/out"}


def about(seconds: float) -> object:
    """These seconds of the node's scripted clock, as far as a record has digits."""
    return pytest.approx(seconds, abs=1e-6)


@pytest.fixture(scope="module")
def node(tmp_path_factory) -> Path:
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler: apt-get install gcc libc6-dev")
    return build(tmp_path_factory.mktemp("preload"))


@pytest.mark.slow
def test_it_compiles_without_a_warning(tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler: apt-get install gcc libc6-dev")
    preload.write_sources(tmp_path)
    source = tmp_path / "preload.c"
    words = [
        "cc",
        "-O2",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-shared",
        "-fPIC",
        str(source),
        "-o",
        str(tmp_path / "x.so"),
        "-ldl",
    ]
    subprocess.run(words, check=True, timeout=600)


@pytest.mark.slow
def test_what_a_request_waited_is_latency_and_not_service(node):
    records, _ = play(node, "take /plan 1 30\nsleep 20\nsend /plan 1 0\n")
    (one,) = records
    assert (one["name"], one["ok"], one["reason"]) == ("/plan", True, None)
    assert one["latency_s"] == about(0.050)
    assert one["service_s"] == about(0.020)


def test_without_the_middleware_s_time_a_request_arrives_when_it_is_taken(node):
    ((one,), _) = play(node, "take /plan 1 -1\nsleep 20\nsend /plan 1 0\n")
    assert one["latency_s"] == one["service_s"] == about(0.020)


@pytest.mark.slow
def test_times_that_no_clock_can_have_meant_are_not_believed(node):
    # A clock that was set while a request waited: in the future, or before the machine began.
    for waited_ms in (-60_000, 10**12):
        ((one,), _) = play(node, f"take /plan 1 {waited_ms}\nsend /plan 1 0\n")
        assert one["latency_s"] == about(0)


def test_requests_that_were_handed_to_a_worker_are_worked_on_one_by_one(node):
    records, _ = play(node, "take /plan 1 0\ntake /plan 2 0\nsleep 20\nsend /plan 1 0\nsleep 20\nsend /plan 2 0\n")
    first, second = records
    assert (first["service_s"], second["service_s"]) == (about(0.020), about(0.020))
    assert (first["latency_s"], second["latency_s"]) == (about(0.020), about(0.040))


def test_responses_to_nobody_other_names_and_failed_calls(node):
    records, _ = play(node, "send /plan 9 0\ntake /other 1 0\ntake /other 2 0\nfail\ntake /plan 3 0\nsend /plan 3 0\n")
    assert [sorted(one) for one in records] == [["at_s", "name", "unmatched"], ["note"]]
    assert records[1]["note"] == "the measured process also takes /other"


def test_requests_that_are_taken_and_not_answered_are_said_once_and_other_names_no_more(node):
    records, _ = played(node, "hear /elsewhere 1\nhear /clock 1\nhear /in 2\nhear /in 3\nhear /later 4\n", TOPICS)
    assert [one["note"] for one in records] == [
        "the measured process also takes /elsewhere", "requests are taken, and none is answered on /out",
    ]  # fmt: skip


def test_a_request_that_is_never_answered_is_lost_when_there_is_no_more_room(node):
    takes = "".join(f"take /plan {i} 0\n" for i in range(1025))
    records, _ = play(node, takes + "send /plan 1024 0\n")
    assert [(one.get("lost"), one["ok"]) for one in records] == [(True, False), (None, True)]


@pytest.mark.parametrize(("status", "reason"), [(4, None), (5, "the goal was canceled"), (6, "the goal was aborted")])
def test_a_goal_is_from_its_request_to_its_result(node, status, reason):
    commands = (
        "goal /go/_action/send_goal 1 77\nsend /go/_action/send_goal 1 1\ngoal /go/_action/get_result 1 77\nsleep 20\n"
    )
    ((one,), _) = play(node, f"{commands}send /go/_action/get_result 1 {status}\n", ACTION)
    assert (one["name"], one["ok"], one["reason"]) == ("/go", reason is None, reason)
    assert one["latency_s"] == about(0.020)


def test_goals_that_overlap_are_told_apart_and_refused_ones_fail(node):
    commands = "".join(f"goal /go/_action/send_goal {i} {70 + i}\n" for i in (1, 2, 3))
    commands += "send /go/_action/send_goal 1 1\nsend /go/_action/send_goal 2 0\nsend /go/_action/send_goal 3 1\n"
    commands += "goal /go/_action/get_result 8 73\ngoal /go/_action/get_result 9 71\nsleep 20\n"
    records, _ = play(node, commands + "send /go/_action/get_result 9 4\nsend /go/_action/get_result 8 4\n", ACTION)
    assert [one["reason"] for one in records] == ["the goal was refused", None, None]
    assert [one["latency_s"] for one in records] == [about(0), about(0.020), about(0.020)]


@pytest.mark.parametrize("kind", ["", "_raw"])
def test_topics_by_stamp(node, kind):
    commands = f"hear{kind} /in 5 10\nhear{kind} /in 6 0\nsay{kind} /out 6\nsay{kind} /out 5\n"
    commands += f"say{kind} /out 7\nsay{kind} /else 5\n"
    second, first, unmatched = play(node, commands, TOPICS)[0]
    assert (first["stamp"], second["stamp"], first["name"]) == ([5, 0], [6, 0], "/out")
    assert (first["latency_s"], second["latency_s"]) == (about(0.010), about(0))
    assert unmatched["unmatched"] is True


def test_of_requests_with_one_stamp_all_but_the_first_fail(node):
    """What a response answers is not known; as `fogspec.agent.matching` has it beside the node."""
    commands = "hear /in 0 0\nsleep 250\nsay /out 0\n" + "hear /in 0 0\nhear /in 0 0\nsleep 50\nsay /out 0\n" * 3
    records, _ = play(node, commands, TOPICS)
    first, *others = records
    assert first["latency_s"] == about(0.250)
    failed = [one for one in others if one.get("ok") is False]
    assert len(failed) == 6
    assert {(one["lost"], one["reason"]) for one in failed} == {(True, NOT_UNIQUE.format(0, 0))}
    assert [one["unmatched"] for one in others if "unmatched" in one] == [True] * 3
    assert not [one for one in others if one.get("ok")]


def test_a_second_subscription_takes_the_same_request(node):
    commands = "hear /in 5 0\nhear_too /in 5 0\nsleep 20\nsay /out 5\nhear_too /in 6 0\nhear /in 6 0\nsay /out 6\n"
    records, _ = play(node, commands, TOPICS)
    assert [(one["ok"], one["latency_s"]) for one in records] == [(True, about(0.020)), (True, about(0))]
    late = "hear /in 5 0\nsay /out 5\nhear_too /in 5 0\nhear /in 6 0\nsay /out 6\n"
    assert [one["ok"] for one in play(node, late, TOPICS)[0]] == [True, True], "nor once it is answered"


def test_topics_by_order(node):
    records, _ = play(node, "hear /in 0 30\nhear /in 0 0\nsay /out 0\nsay /out 0\nsay /out 0\n", ORDER)
    assert [one.get("unmatched", False) for one in records] == [False, False, True]
    assert [one["latency_s"] for one in records[:2]] == [about(0.030), about(0)]


@pytest.mark.slow
def test_it_costs_microseconds(node):
    # 5 µs where nothing else runs; `python -m tests.ros.figures` prints it.
    assert cost_s(node, 20_000) < 100e-6


def test_it_does_nothing_unless_measured(node, tmp_path, monkeypatch):
    monkeypatch.delenv("FOGSPEC_TIMINGS", raising=False)
    words = [sys.executable, "-m", "fogspec.agent.preload", "--service", "/plan", "--", "env"]
    said = subprocess.run(words, capture_output=True, text=True, check=True, timeout=600).stdout
    assert "LD_PRELOAD" not in said


def started(tmp_path: Path, *words: str, path: str) -> "subprocess.CompletedProcess[str]":
    environment = {
        "PATH": path,
        "FOGSPEC_TIMINGS": str(tmp_path / "timings.jsonl"),
        "PYTHONPATH": str(Path(__file__).parents[3]),
    }
    command = [sys.executable, "-m", "fogspec.agent.preload", "--service", "/plan", *words]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)


@pytest.mark.slow
def test_a_machine_without_a_compiler_and_a_program_that_is_not_there(tmp_path, node):
    ended = started(tmp_path, "--", "env", path="/nowhere")
    assert ended.returncode == 1
    assert ended.stderr.startswith("the measured machine has no C compiler: install gcc and libc6-dev there")
    ended = started(tmp_path, "--", "/no/such/program", path="/usr/bin:/bin")
    assert ended.stderr == "/no/such/program cannot be started: No such file or directory\n"
    assert started(tmp_path, "env", path="/usr/bin").returncode == 2


def test_where_timing_is_optional_the_command_starts_in_any_case(tmp_path):
    ended = started(tmp_path, "--optional", "--", "/usr/bin/env", path="/nowhere")
    assert ended.returncode == 0
    assert ended.stderr.startswith("fogspec: requests are not timed: the measured machine has no C compiler")
    assert "LD_PRELOAD" not in ended.stdout


@pytest.mark.slow
def test_the_command_s_own_words_stay_as_they_are(tmp_path, node):
    ended = started(tmp_path, "--", "printf", "%s|", "--service", "--", "-x", path="/usr/bin:/bin")
    assert ended.stdout == "--service|--|-x|"
