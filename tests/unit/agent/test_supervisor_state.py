"""What is read out of a deployment's log: it came from another machine, so nothing in it is trusted."""

import json

import pytest

from fogspec.agent import supervisor
from fogspec.agent.packages import packed
from fogspec.backends import agent_state


def line(**said) -> bytes:
    return b"\x1b[36m(task, pid=7)\x1b[0m === fogspec state " + json.dumps(said).encode() + b" ===\n"


def test_the_last_word_counts() -> None:
    log = (
        line(state="starting", ready_s=None)
        + b"nodes talk\n"
        + line(state="ready", ready_s=2.5, observed=True)
        + b"more\n"
    )
    live = agent_state.status_in_log(log, "192.0.2.1")
    assert (live.state, live.ready_s, live.address, live.observed) == ("ready", 2.5, "192.0.2.1", True)


def test_packages_are_those_of_the_latest_report_that_lists_them() -> None:
    older, newer = (packed(f"dpkg libc6 {version}\n") for version in ("2.35", "2.39"))
    log = line(state="ready", packages=older) + line(state="ready", packages=newer) + line(state="ready")
    assert agent_state.status_in_log(log, None).packages == "dpkg libc6 2.39\n"
    assert agent_state.status_in_log(line(state="ready"), None).packages is None
    assert agent_state.status_in_log(line(state="ready", packages="x" * 100), None).packages is None


def test_silence() -> None:
    assert agent_state.status_in_log(b"nodes talk\n", None) is None


def test_what_is_open_and_when_is_in_the_log_too(tmp_path) -> None:
    rows = [
        {"open": "plan", "process": "7-a", "number": 1, "start_s": 50.0},
        {"name": "plan", "process": "7-a", "number": 1, "start_s": 50.0, "latency_s": 0.5, "ok": True},
        {"open": "plan", "process": "7-a", "number": 2, "start_s": 51.0},
        {"name": "plan", "latency_s": 0.25, "ok": True},
        ["no record"],
    ]
    (tmp_path / "t").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    said = supervisor.latest(tmp_path / "t")
    ended = [["plan", 0.5, True, None, 50.5], ["plan", 0.25, True, None, None]]
    assert said == {"latest": ended, "open": [["plan", 51.0]]}
    live = agent_state.status_in_log(line(state="ready", clock_s=60.0, **said), None)
    assert live.clock_s == 60.0
    first, second, opened = (json.loads(one) for one in live.timings.splitlines())
    assert (first["start_s"], first["latency_s"], "start_s" in second) == (50.0, 0.5, False)
    assert opened == {"open": "plan", "process": "open 0", "number": 1, "start_s": 51.0}
    for wrong in (True, "now", 1e300):
        assert (
            agent_state.status_in_log(line(state="ready", clock_s=wrong, open=[["plan", wrong], 7]), None).clock_s
            is None
        )


def test_the_time_is_that_of_the_timings_whatever_clock_they_have(tmp_path, monkeypatch) -> None:
    """A node may time by a clock that is not this machine's; how long nothing was written is a duration."""
    monkeypatch.setattr(supervisor.time, "monotonic", lambda: now_s)
    now_s = 9000.0
    run = supervisor.Supervisor(supervisor.parse(["--out", str(tmp_path), "--process", '["true"]']))
    assert run._clock_s({"latest": [], "open": []}) is None
    run.timings.write_text(json.dumps({"open": "plan", "process": "7-a", "number": 1, "start_s": 2.0}) + "\n")
    now_s = 9100.0
    run._bound_files()
    now_s = 9130.0
    run._bound_files()
    assert run._clock_s(supervisor.latest(run.timings)) == 32.0


def test_requests_in_few_words() -> None:
    live = agent_state.status_in_log(
        line(state="ready", latest=[["plan", 0.5, True, None], ["plan", 0.1, False, "door"], ["x"], 7]), None
    )
    records = [json.loads(one) for one in live.timings.splitlines()]
    assert [(one["latency_s"], one["ok"], one["scenario"]) for one in records] == [
        (0.5, True, None),
        (0.1, False, "door"),
    ]


@pytest.mark.parametrize(
    "said",
    [
        {"state": "perfect"}, {"state": None}, {"state": ["ready"]}, {"state": "ready", "ready_s": "soon", "detail": 5},
        {"state": "ready", "ready_s": -1}, {"state": "ready", "latest": "many"}, {"state": "ready", "link": "rm -rf /; $(x)"},
    ],
)  # fmt: skip
def test_rubbish_is_left_out(said) -> None:
    live = agent_state.status_in_log(line(**said), None)
    assert live.state in ("starting", "ready")
    assert (live.ready_s, live.link, live.timings) == (None, None, b"")


def test_broken_json_and_long_words() -> None:
    assert agent_state.status_in_log(b"=== fogspec state {not json} ===\n", None).state == "starting"
    said = agent_state.status_in_log(line(state="ended", detail="\x1b[31m" + "x" * 1000), None)
    assert said.detail is not None
    assert len(said.detail) == 300
    assert "\x1b" not in said.detail


def test_timings_are_cut_at_a_line() -> None:
    whole = b'{"latency_s": 1}\n' * 100_000
    cut = agent_state.tail(whole)
    assert len(cut) <= agent_state.TAIL_BYTES
    assert cut.startswith(b"{")
    assert cut.endswith(b"\n")
    assert agent_state.tail(b"short\n") == b"short\n"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("[python3 a.py] no such model", "python3 a.py ended with exit code 1: no such model"),
        ("[camera] lost", "python3 a.py ended with exit code 1: [camera] lost"),
        ("no such model", "python3 a.py ended with exit code 1: no such model"),
    ],
)
def test_the_name_of_the_node_that_ended_is_written_once(line: str, said: str) -> None:
    state = json.dumps({"state": "ended", "detail": "python3 a.py ended with exit code 1"}).encode()
    status = agent_state.deployment_status(state, b"", None)
    assert agent_state.with_last_line(status, line.encode()).detail == said


LAUNCHED = """\
[INFO] [client-2]: process started with pid [8]
[slam-1] loading the map
[slam-1] map is broken
[client-2] no pose
[ERROR] [slam-1]: process has died [pid 7, exit code -9, cmd '/ws/lib/visual_slam/slam --ros-args'].
[INFO] [client-2]: sending signal 'SIGINT' to process[client-2]
[ERROR] [client-2]: process has died [pid 8, exit code -2, cmd '/ws/lib/visual_slam/client --ros-args'].
"""


@pytest.mark.parametrize(
    ("detail", "log", "said"),
    [
        ("ros2 launch ended with exit code 1", LAUNCHED, "slam was killed (SIGKILL): map is broken"),
        ("ros2 launch ended with exit code 0", "[b-2]: process has finished cleanly [pid 7]", "b ended with exit code 0"),
        ("ros2 launch ended with exit code 1", "no such file", "ros2 launch ended with exit code 1: no such file"),
        # What another process brought down ended after it.
        ("bash ended with exit code 1", LAUNCHED, f"bash ended with exit code 1: {LAUNCHED.splitlines()[-1]}"),
    ],
)  # fmt: skip
def test_of_the_nodes_of_a_launch_the_one_that_ended_first_is_the_cause(detail: str, log: str, said: str) -> None:
    status = agent_state.deployment_status(json.dumps({"state": "ended", "detail": detail}).encode(), b"", None)
    assert agent_state.with_last_line(status, log.encode()).detail == said
