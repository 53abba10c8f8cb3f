"""Which end of a process ends the deployment, and how long a restart waits; times are given, none is waited for."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.agent import processes, supervisor
from fogspec.agent.supervisor import LONGEST_DELAY_S, MOST_RESTARTS, STEADY_S, Kept, parse
from fogspec.backends.agent_state import deployment_status
from tests.support.agent import AGENT
from tests.unit.agent.test_sample import ENDS, FOLLOWS


def kept(respawn: str | None, delay_s: float = 1.0) -> Kept:
    return Kept(["node"], "node", respawn, delay_s)


@pytest.mark.parametrize(
    ("respawn", "code", "again"),
    [(None, 0, False), (None, 1, False), ("on_failure", 0, False), ("on_failure", 1, True), ("on_failure", -9, True),
     ("always", 0, True), ("always", 1, True)],
)  # fmt: skip
def test_which_ends_are_restarted(respawn: str | None, code: int, again: bool) -> None:
    assert (kept(respawn).ended(code, 5.0) is None) == again


@given(delay_s=st.floats(0.001, 1e4), codes=st.lists(st.integers(-15, 3), min_size=1, max_size=20))
def test_each_restart_in_a_row_waits_longer_and_there_is_a_last(delay_s: float, codes: list[int]) -> None:
    one, now_s, waits = kept("always", delay_s), 0.0, []
    for code in codes:
        one.started_s = now_s
        now_s += 1.0
        if (why := one.ended(code, now_s)) is not None:
            assert len(waits) == MOST_RESTARTS
            assert f"after {MOST_RESTARTS} restarts in a row" in why
            break
        assert one.due_s is not None
        waits.append(round(one.due_s - now_s, 6))  # as the clock adds up
        now_s = one.due_s
    assert waits == sorted(waits)
    assert max(waits) <= LONGEST_DELAY_S + 1e-6


def test_a_process_that_stayed_up_starts_from_the_first_delay() -> None:
    one = kept("always")
    one.in_a_row, one.started_s = MOST_RESTARTS, 0.0
    assert one.ended(1, STEADY_S) is None
    assert one.due_s == STEADY_S + 1.0


def test_command_lines() -> None:
    given = {"argv": ["a", "b"], "name": "planner", "respawn": "always", "respawn_delay": 2}
    options = parse(
        ["--out", "x", "--process", json.dumps(given), "--process", json.dumps(given), "--process", '["/bin/c"]']
    )
    assert [(one.name, one.respawn, one.delay_s) for one in options.process] == [
        ("planner", "always", 2.0), ("planner 2", "always", 2.0), ("c", None, 1.0),
    ]  # fmt: skip
    for wrong in (
        {},
        {"argv": []},
        {**given, "respawn": "never"},
        {**given, "respawn_delay": "2s"},
        {**given, "name": 1},
        5,
    ):
        with pytest.raises(SystemExit):
            parse(["--out", "x", "--process", json.dumps(wrong)])


@pytest.mark.parametrize(
    ("words", "left_s"),
    [
        ([], None),
        (["--lifetime", "100"], 100.0),
        (["--lifetime", "100", "--ends", "+50"], 50.0),
        (["--lifetime", "100", "--ends", "+5000"], 100.0),
        (["--lifetime", "100", "--ends", "-50"], 0.0),
        (["--lifetime", "100", "--ends", "-90000000"], 100.0),  # a clock that is plainly wrong
    ],
)
def test_when_all_end(words: list[str], left_s: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor.time, "time", lambda: 1e9)
    monkeypatch.setattr(supervisor.time, "monotonic", lambda: 7.0)
    words = [str(1e9 + float(word)) if word[0] in "+-" and word[1] != "-" else word for word in words]
    made = supervisor.Supervisor(parse(["--out", "x", *words, "--process", '["a"]']))
    assert made.over_s == (None if left_s is None else 7.0 + left_s)
    assert time.time() == 1e9


def test_counts_from_a_machine_are_checked() -> None:
    said = {"a": 2, "b\x1b": 1, "c": -1, "d": True, "e": "3", "f": 10**12}
    assert deployment_status(json.dumps({"restarts": said}).encode(), b"", None).restarts == {"a": 2, "b": 1}
    assert deployment_status(b'{"restarts": [1]}', b"", None).restarts == {}


def test_a_parameter_that_a_node_lacks_is_in_the_state_and_ends_nothing(tmp_path: Path) -> None:
    said = "/plan declares no parameter wrok"
    asks = f"print({said!r}); raise SystemExit(3)"
    node = f"import pathlib, time\nwhile {said!r} not in pathlib.Path('out/state.json').read_text(): time.sleep(0.01)"
    words = [word for name, code in (("--asks", asks), ("--process", node))
             for word in (name, json.dumps([sys.executable, "-c", code]))]  # fmt: skip
    command = [sys.executable, str(AGENT), "supervisor", "--out", "out", *words]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    reports = [json.loads(line[len("=== fogspec state ") : -len(" ===")]) for line in ended.stdout.splitlines()]
    assert ("starting", said) in [(one["state"], one["detail"]) for one in reports]
    assert reports[-1]["detail"].endswith("ended with exit code 0")


def test_the_node_that_ended_first_is_the_cause(tmp_path: Path) -> None:
    given = []
    for name, script in (("client", FOLLOWS), ("slam", ENDS + "os.kill(os.getpid(), 9)")):
        argv = [sys.executable, "-c", script, str(tmp_path / "pid")]
        given += ["--process", json.dumps({"argv": argv, "name": name})]
    subprocess.run([sys.executable, str(AGENT), "supervisor", "--out", "out", *given], cwd=tmp_path, timeout=600)
    assert json.loads((tmp_path / "out" / "state.json").read_text())["detail"] == "slam was killed (SIGKILL)"


def test_what_ends_before_it_can_be_watched_is_the_cause_of_what_ends_after_it() -> None:
    def started(code: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)

    def end(one: subprocess.Popen[bytes]) -> None:
        one.kill()
        os.waitid(os.P_PID, one.pid, os.WEXITED | os.WNOWAIT)

    ends = processes.Ends()
    early, client, slam = (started("input()") for _ in range(3))
    for one in (early, client):
        ends.watch(one)
    end(early)
    ends.look()  # before slam is started
    end(slam)
    end(client)
    ends.watch(slam)
    assert ends.new() == [early, slam, client]
    assert ends.new() == []
    for one in (early, client, slam):
        one.communicate()


@pytest.mark.parametrize(
    ("argv", "name"),
    [
        (["/usr/bin/python3", "a.py"], "python3"),
        (["python3", "-m", "fogspec_agent.topics", "--request", "/a"], "fogspec's topics"),
        (["sh", "-c", 'exec ros2 launch "$HOME/cloud.launch.py"'], "ros2 launch"),
        (["python3", "-m", "fogspec_agent.preload", "--service", "/a", "--", "/bin/node", "x"], "node"),
    ],
)
def test_a_process_without_a_name_has_that_of_its_program(argv: list[str], name: str) -> None:
    assert processes.program(argv) == name
