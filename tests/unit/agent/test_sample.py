"""Measuring a sample: every way a workload can behave ends in an outcome that reports it."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest

from fogspec.agent import processes, ros, sample, stopping
from fogspec.results.requests import RecordRules, parse_requests
from tests.support.agent import AGENT

SAMPLE = [sys.executable, str(AGENT), "sample"]
TIMED = """
import json, os, sys, time
def say(latency, ok=True, end="\\n"):
    with open(os.environ["FOGSPEC_TIMINGS"], "a") as f:
        f.write(json.dumps({"name": "plan", "start_s": time.monotonic(), "latency_s": latency, "ok": ok,
                            "metrics": {}, "reason": None}) + end)
"""


def run(tmp_path: Path, *scripts: str, steps=5, after=600.0, warmup=1, startup=120.0, extra=(), environment=None):
    processes = [w for s in scripts for w in ("--process", json.dumps([sys.executable, "-c", TIMED + s]))]
    limits = ["--after", str(after), "--warmup", str(warmup), "--startup", str(startup)]
    command = [*SAMPLE, "--out", str(tmp_path / "out"), *limits, *extra, *processes]
    if steps is not None:
        command += ["--steps", str(steps)]
    ended = subprocess.run(command, timeout=1200, capture_output=True, text=True, env=environment)
    outcome = json.loads((tmp_path / "out" / "outcome.json").read_text())
    assert ended.returncode == (0 if outcome["state"] == "ok" else 1), ended.stderr
    return outcome


FOREVER = "while True: say(0.01); time.sleep(0.01)"


def test_stops_by_steps_warm_up_not_counted(tmp_path):
    outcome = run(tmp_path, FOREVER, steps=20, warmup=3)
    assert (outcome["state"], outcome["stopped_by"]) == ("ok", "steps")
    assert outcome["requests"] >= 23
    assert 0 < outcome["setup_s"] < outcome["duration_s"]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"ROS_DISTRO": "jazzy"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}),
        ({"ROS_DISTRO": "humble"}, {"ROS_LOCALHOST_ONLY": "1"}),
        (
            {
                "ROS_DOMAIN_ID": "187",
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
                "ROS_STATIC_PEERS": "192.0.2.1",
                "ROS_DISCOVERY_SERVER": "192.0.2.1:11811",
                "ROS_SUPER_CLIENT": "1",
                "ROS2_EASY_MODE": "192.0.2.1",
            },
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        ),
        ({"ROS_DISTRO": "humble", "ROS_LOCALHOST_ONLY": "0"}, {"ROS_LOCALHOST_ONLY": "1"}),
        ({"ROS_DISTRO": "humble", "CYCLONEDDS_URI": "file:///mine.xml"}, {"ROS_LOCALHOST_ONLY": "1"}),
    ],
)
def test_a_sample_has_a_ros_graph_of_its_own_whatever_the_shell_has(tmp_path, given, expected):
    """A robot of the shell's domain is neither heard nor driven."""
    tell = f"json.dump(dict(os.environ), open({str(tmp_path / 'environment')!r}, 'w'))\n{FOREVER}"
    run(tmp_path, tell, environment={"PATH": "/usr/bin:/bin", **given})
    found = json.loads((tmp_path / "environment").read_text())
    assert 1 <= int(found.pop("ROS_DOMAIN_ID")) <= 101
    distro = {name: value for name, value in given.items() if name == "ROS_DISTRO"}
    assert {name: found[name] for name in found if name.startswith("ROS")} == {**distro, **expected}
    assert found["CYCLONEDDS_URI"] == given.get("CYCLONEDDS_URI", ros.CYCLONE)
    assert [one.text for one in ElementTree.fromstring(ros.CYCLONE).iter() if one.text] == ["auto", "119"]


def test_a_domain_in_which_somebody_listens_is_used():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listens:
        domain = next(one for one in ros.DOMAINS if ros._is_unused(one))
        listens.bind(("127.0.0.1", ros.FIRST_PORT + ros.PORTS_A_DOMAIN * domain))
        assert not ros._is_unused(domain)
        assert ros._unused_domain() != domain


@pytest.mark.slow
def test_stops_by_time(tmp_path):
    outcome = run(tmp_path, FOREVER, steps=None, after=0.5, warmup=0)
    assert (outcome["state"], outcome["stopped_by"]) == ("ok", "time")
    assert outcome["duration_s"] - outcome["setup_s"] >= 0.5


def test_stops_as_soon_as_the_mean_is_known_well_enough(tmp_path):
    some = "[say(0.01) for _ in range(20)]; time.sleep(3600)"
    outcome = run(tmp_path, some, steps=100_000, extra=["--precision", "0.05"])
    assert outcome["stopped_by"] == "precision"
    assert 11 <= outcome["requests"] <= 20


@pytest.mark.parametrize(("above", "requests", "stopped_by"), [("0.009", 15, "decided"), ("0.011", 30, "steps")])
def test_ends_once_the_mean_is_certainly_above_the_latency_that_decides(tmp_path, above, requests, stopped_by):
    some = f"[say(0.01) for _ in range({requests})]; time.sleep(3600)"
    outcome = run(tmp_path, some, steps=20, extra=["--decided-above", above])
    assert (outcome["state"], outcome["stopped_by"]) == ("ok", stopped_by)


def test_a_crash_says_how(tmp_path):
    outcome = run(tmp_path, "say(1.0); raise SystemExit('no camera')")
    assert (outcome["state"], outcome["reason"], outcome["exit_codes"]) == ("failed", "crash", [1])
    assert "exit code 1: no camera" in outcome["detail"]


def test_one_process_of_two_that_crashes_ends_both(tmp_path):
    outcome = run(tmp_path, "time.sleep(600)", "import ctypes; ctypes.string_at(0)")
    assert outcome["reason"] == "crash"
    assert "ended by SIGSEGV (Segmentation fault)" in outcome["detail"]
    assert None not in outcome["exit_codes"]


def test_memory_that_runs_out_is_told_from_a_crash(tmp_path):
    assert run(tmp_path, "raise MemoryError")["reason"] == "out_of_memory"


@pytest.mark.parametrize(
    "script", ["time.sleep(600)", "raise SystemExit('a worker is gone')", "say(1.0); time.sleep(600)"]
)
def test_the_kernel_s_kills_for_want_of_memory_explain_what_came_of_them(tmp_path, monkeypatch, script):
    # Running a whole machine out of memory is no test's business: the counter is what it would be.
    kills = iter([7])
    monkeypatch.setattr(processes, "memory_kills", lambda: next(kills, 8))
    monkeypatch.setattr(sample, "ARCHIVE", AGENT)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    arguments = ["--out", str(tmp_path), "--after", "0.3", "--startup", "0.5", "--warmup", "1"]
    assert sample.main([*arguments, "--process", json.dumps([sys.executable, "-c", TIMED + script])]) == 1
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert (outcome["state"], outcome["reason"]) == ("failed", "out_of_memory")
    assert "the kernel ended a process for lack of memory" in outcome["detail"]


def test_the_kernel_s_counter_is_read(tmp_path, monkeypatch):
    assert processes.memory_kills() >= 0
    monkeypatch.setattr(processes, "VMSTAT", tmp_path / "vmstat")
    monkeypatch.setattr(processes, "memory_counters", list)
    assert processes.memory_kills() == 0
    (tmp_path / "vmstat").write_text("pgfault 12\noom_kill 3\nnr_x 1\n")
    assert processes.memory_kills() == 3


def test_a_program_that_is_not_there(tmp_path):
    limits = ["--after", "1", "--startup", "1", "--process", '["/no/such/program"]']
    subprocess.run([*SAMPLE, "--out", str(tmp_path), *limits], timeout=600)
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert (outcome["state"], outcome["reason"]) == ("failed", "setup")
    assert "/no/such/program cannot be started: No such file" in outcome["detail"]


@pytest.mark.slow
def test_a_silent_end_and_silence_are_no_response(tmp_path):
    outcome = run(tmp_path / "a", "pass")
    assert (outcome["reason"], outcome["stopped_by"]) == ("no_response", "exit")
    outcome = run(tmp_path / "b", "time.sleep(600)", startup=0.5)
    assert (outcome["reason"], outcome["stopped_by"]) == ("no_response", "startup")
    assert outcome["duration_s"] >= 0.5


@pytest.mark.slow
def test_a_hang_after_the_first_request_is_ended_by_time_and_leaves_a_lower_bound(tmp_path):
    outcome = run(tmp_path, "say(0.1); time.sleep(600)", after=0.6)
    assert (outcome["state"], outcome["stopped_by"]) == ("timeout", "time")
    assert 0.5 < outcome["waited_s"] < outcome["duration_s"]


@pytest.mark.slow
def test_silence_after_whoever_asked_has_ended_tells_nothing(tmp_path):
    # Timed once it has ended, however long that takes: the sample's time begins with the request.
    asks = f"open({str(tmp_path / 'pid')!r}, 'w').write(f'{{os.getpid()}}.')"
    gone = FOLLOWS.replace("sys.argv[1]", repr(str(tmp_path / "pid"))).partition("raise")[0]
    outcome = run(tmp_path, asks, f"{gone}say(0.1); time.sleep(600)", after=0.6, warmup=0)
    assert (outcome["state"], outcome["stopped_by"], outcome["waited_s"]) == ("ok", "time", None)


def test_a_workload_that_ends_by_itself_was_measured(tmp_path):
    outcome = run(tmp_path, "[say(0.1) for _ in range(4)]", steps=100)
    assert (outcome["state"], outcome["stopped_by"], outcome["requests"]) == ("ok", "exit", 4)


def test_partial_and_senseless_lines(tmp_path):
    script = r"""
with open(os.environ["FOGSPEC_TIMINGS"], "ab", buffering=0) as f:
    f.write(b'\xff\xfe\n[]\n{"latency_s": -1, "ok": true}\n{"latency_s": NaN, "ok": true}\n')
    f.write(b'{"latency_s": 1' + b'0' * 400 + b', "ok": true}\n' + b'[' * 5000 + b'\n')
    f.write(b'{"latency_s": 0.5,'); time.sleep(0.3); f.write(b' "ok": true}\n{"latency_s": 0.5, "ok"')
"""
    outcome = run(tmp_path, script, warmup=0)
    assert (outcome["requests"], outcome["unreadable"]) == (1, 6)


@pytest.mark.slow
def test_processes_that_detach_and_ignore_signals_are_ended(tmp_path):
    stubborn = """
import signal, subprocess
for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, signal.SIG_IGN)
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        open(os.environ["FOGSPEC_TIMINGS"] + ".pid", "w").write(str(os.getpid()))
        while True: time.sleep(1)
    os._exit(0)
known = os.environ["FOGSPEC_TIMINGS"] + ".pid"
while not os.path.exists(known) or not os.path.getsize(known): time.sleep(0.01)
while True: say(0.01); time.sleep(0.05)
"""
    run(tmp_path, stubborn, steps=8)
    pid = int((tmp_path / "out" / "timings.jsonl.pid").read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_term_is_answered_with_an_outcome(tmp_path):
    limits = ["--after", "600", "--startup", "120", "--process", json.dumps([sys.executable, "-c", TIMED + FOREVER])]
    started = subprocess.Popen([*SAMPLE, "--out", str(tmp_path), *limits])
    while not (tmp_path / "timings.jsonl").exists() or not (tmp_path / "timings.jsonl").stat().st_size:
        time.sleep(0.02)
    started.send_signal(signal.SIGTERM)
    assert started.wait(600) == 1
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert (outcome["reason"], outcome["detail"]) == ("interrupted", "ended by SIGTERM (Terminated)")
    assert outcome["requests"] >= 1


@pytest.mark.slow
def test_logs_are_kept_small(tmp_path, monkeypatch):
    # However much faster than the agent it is: it waits until its log has been cut.
    chatty = f"""
while True:
    print('x' * 2**20, flush=True)
    say(0.01)
    while os.fstat(1).st_size > {sample.LOG_LIMIT}: time.sleep(0.005)
"""
    outcome = run(tmp_path, chatty, steps=60)
    assert outcome["stopped_by"] == "steps"
    assert (tmp_path / "out" / "process-0.log").stat().st_size < 2 * sample.LOG_LIMIT


def test_the_probes_are_importable_and_shadow_no_module_of_the_workload(tmp_path):
    looks = "import fogspec_probe, fogspec_agent.topics, importlib.util as u\nassert u.find_spec('sample') is None\nsay(1.0)"
    outcome = run(tmp_path, looks, warmup=0)
    assert outcome["state"] == "ok"


def test_a_full_disk_does_not_silence_it(tmp_path, monkeypatch):
    sample.reserve(tmp_path)
    assert (tmp_path / "outcome.part").stat().st_size >= 16384
    sample.write_outcome(tmp_path, {"state": "ok", "detail": "x" * 9000})
    assert json.loads((tmp_path / "outcome.json").read_text())["state"] == "ok"
    assert not (tmp_path / "outcome.part").exists()


def test_an_out_folder_that_cannot_be_written_is_said_on_standard_error(tmp_path):
    (tmp_path / "out").write_text("a file")
    limits = ["--after", "1", "--startup", "1", "--process", '["true"]']
    ended = subprocess.run([*SAMPLE, "--out", str(tmp_path / "out"), *limits],
                           capture_output=True, text=True, timeout=600)  # fmt: skip
    assert ended.returncode == 1
    assert "the agent could not work" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (1, "ended with exit code 1"), (255, "ended with exit code 255"),
        (139, "was ended by SIGSEGV (Segmentation fault, exit code 139)"),
        (-9, "was killed (SIGKILL)"), (137, "was killed (SIGKILL, exit code 137)"),
        (247, "was killed (SIGKILL, exit code 247)"),  # as `ros2 run` passes it on
        (-11, "was ended by SIGSEGV (Segmentation fault)"), (-64, "was ended by SIGRTMAX (Real-time signal 30)"),
        (-40, "was ended by signal 40"),
    ],
)  # fmt: skip
def test_an_end_is_told_by_the_name_of_its_signal(code, said):
    assert processes.exit_text(code) == said


ENDS = "import os, sys; open(sys.argv[1], 'w').write(f'{os.getpid()}.'); "
FOLLOWS = """
import contextlib, os, sys
pid = ""
while not pid.endswith("."):
    pid = open(sys.argv[1]).read() if os.path.exists(sys.argv[1]) else ""
with contextlib.suppress(OSError):  # it is gone already
    while ") Z" not in open(f"/proc/{pid[:-1]}/stat").read(): pass
raise SystemExit("the server is gone")
"""


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("os.kill(os.getpid(), 9)", "slam was killed (SIGKILL)"),
        ("", "client ended with exit code 1: the server is gone; slam had ended before, with exit code 0"),
    ],
)
def test_the_process_that_ended_first_is_told_by_its_name(tmp_path, how, said):
    given = []
    for name, script in (("client", FOLLOWS), ("slam", ENDS + how)):
        argv = [sys.executable, "-c", script, str(tmp_path / "pid")]
        given += ["--process", json.dumps({"argv": argv, "name": name})]
    outcome = run(tmp_path, "time.sleep(600)", extra=given)
    assert (outcome["reason"], outcome["detail"]) == ("crash", said)


@pytest.mark.parametrize("wrong", ['"text"', "[]", "[1]", "{", '{"a": 1}'])
def test_a_wrong_process_is_refused(wrong):
    with pytest.raises(SystemExit) as end:
        sample.parse(["--out", "x", "--after", "1", "--startup", "1", "--process", wrong])
    assert end.value.code == 2


def test_only_requests_of_the_callback_count(tmp_path):
    script = """
other = lambda: open(os.environ["FOGSPEC_TIMINGS"], "a").write('{"name": "inner", "latency_s": 9, "ok": true}\\n')
while True: [other() for _ in range(5)]; say(0.01); time.sleep(0.02)
"""
    outcome = run(tmp_path, script, steps=4, warmup=1, extra=["--callback", "plan"])
    assert (outcome["stopped_by"], outcome["unreadable"]) == ("steps", 0)
    lines = (tmp_path / "out" / "timings.jsonl").read_text().splitlines()
    assert sum('"plan"' in line for line in lines) >= 5


@pytest.mark.parametrize("name", ["plann", "Plan", "paln", "p_lan"])
def test_a_slip_in_the_callback_s_name_ends_the_sample_with_the_first_request(tmp_path, name):
    outcome = run(tmp_path, "say(0.01); time.sleep(600)", startup=600.0, extra=["--callback", name])
    assert (outcome["state"], outcome["reason"], outcome["stopped_by"]) == ("failed", "not_reported", "startup")
    wanted = f"no request named {name!r} was timed, only 'plan': compare spec.probe with what the workload times"
    assert outcome["detail"] == wanted


def run_here(tmp_path, monkeypatch, script, *extra):
    """The outcome of a sample in this process, in which the tenth of the time for the first request is a second of many."""
    monkeypatch.setattr(sample, "MISNAMED", 0.6 / 600)
    monkeypatch.setattr(sample, "ARCHIVE", AGENT)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    limits = ["--out", str(tmp_path), "--after", "600", "--startup", "600", *extra]
    sample.main([*limits, "--process", json.dumps([sys.executable, "-c", TIMED + script])])
    return json.loads((tmp_path / "outcome.json").read_text())


def test_another_name_ends_the_sample_after_a_tenth_of_the_time(tmp_path, monkeypatch):
    assert sample.MISNAMED == 0.1
    outcome = run_here(tmp_path, monkeypatch, FOREVER, "--callback", "localise")
    assert outcome["detail"].startswith("no request named 'localise' was timed, only 'plan'")
    assert outcome["duration_s"] >= 0.6


@pytest.mark.parametrize(("then", "detail"), [("", "no node publishes /poze (there is /pose)"), ("topics", None)])
def test_a_topic_of_nearly_this_name_is_waited_for_during_a_tenth_of_the_time(tmp_path, monkeypatch, then, detail):
    script = f"""
def note(**more): open(os.environ["FOGSPEC_TIMINGS"], "a").write(json.dumps(more) + "\\n")
note(note="no node publishes /poze (there is /pose)", misnamed=True)
if {then!r}: note(note="its topics are published"); time.sleep(1); say(0.01)
time.sleep(0 if {then!r} else 600)
"""
    outcome = (
        run(tmp_path, script, steps=1, warmup=0, startup=600.0) if then else run_here(tmp_path, monkeypatch, script)
    )
    assert (outcome["reason"], (outcome["detail"] or "")[: len(detail or "")]) == (
        detail and "not_reported",
        detail or "",
    )


def test_a_request_that_has_started_is_waited_for_whatever_else_ends_before_it(tmp_path):
    script = """
import fogspec_probe
with fogspec_probe.request("plann"):
    for _ in range(10): say(0.01); time.sleep(0.05)
[say(0.01) for _ in range(3)]
"""
    outcome = run(tmp_path, script, steps=1, warmup=0, startup=600.0, extra=["--callback", "plann"])
    assert (outcome["state"], outcome["requests"]) == ("ok", 1)


EXPECTED = [
    ("path", "value of metric path on /reslt", "inf"), ("quality", "value of metric quality", "20"),
    ("scenario easy", "request of scenario easy", "20"), ("scenario hard", "request of scenario hard", "50"),
]  # fmt: skip


def test_a_topic_has_a_minute_to_be_heard_and_a_keyword_twenty_requests(tmp_path):
    """A listener on a topic may be slower than twenty requests; the clock is the test's."""
    note = '{"note": "no node publishes /reslt"}\n'
    timings = stopping.Timings(tmp_path / "t", 1, "plan")
    timings.expected = EXPECTED
    assert timings.unheard(600.0) is None, "no request has ended"
    (tmp_path / "t").write_text(note + answer("qualty=1") * 20)
    timings.read()
    path = "no value of metric path on /reslt: no node publishes /reslt"
    quality = "no value of metric quality: the node reported qualty"
    assert timings.unheard(59.0) == (f"{path}; {quality}", False), "19 are valid"
    assert timings.unheard(60.0) == (f"{path}; {quality}", True)
    assert timings.unheard(0.0, over=True) == (f"{path}; {quality}", True), "the slip is certain"
    (tmp_path / "t").write_text(note + answer("qualty=1") * 20 + answer("quality=1") * 60)
    timings.read()
    assert timings.unheard(600.0) == (path, True), "a hard one may be rare in the bag"
    assert "no request of scenario hard" in timings.unheard(0.0, over=True)[0]
    timings = stopping.Timings(tmp_path / "t", 1, "plan")
    timings.expected = EXPECTED
    (tmp_path / "t").write_text(note + answer("qualty=1") * 20 + answer("quality=1", "hrad") + answer() * 30)
    timings.read()
    hard = "no request of scenario hard: the node reported scenario hrad"
    assert timings.unheard(59.0) == (f"{path}; {hard}", True)
    with open(tmp_path / "t", "a") as file:
        file.write('{"metric": {"path": 3.5}, "at_s": 1.0}\n' + answer("quality=1", "hard"))
    timings.read()
    assert timings.unheard(600.0) is None


def answer(metric: str = "", scenario: str = "easy") -> str:
    name, _, value = metric.partition("=")
    metrics = {name: float(value)} if name else {}
    return json.dumps({"name": "plan", "latency_s": 1.0, "ok": True, "metrics": metrics, "scenario": scenario}) + "\n"


def test_names_that_a_slip_does_not_explain():
    assert stopping.mistyped("plan_path", "PlanPath")
    for one, other in (("plan", "replan"), ("plan_1", "plan_2"), ("left", "right"), ("plan", "plans1")):
        assert not stopping.mistyped(one, other)


def afterwards(script: str) -> tuple[str, str]:
    return "--afterwards", json.dumps([sys.executable, "-c", TIMED + script])


@pytest.mark.slow
def test_records_that_are_written_once_everything_has_ended(tmp_path):
    reads = "import pathlib; assert float(os.environ['FOGSPEC_BEGUN']) <= time.time(); [say(0.1) for _ in range(4)]"
    outcome = run(tmp_path / "a", "time.sleep(600)", steps=None, after=0.6, extra=afterwards(reads))
    assert (outcome["state"], outcome["stopped_by"], outcome["requests"]) == ("ok", "time", 4)
    assert outcome["duration_s"] >= 0.6
    outcome = run(tmp_path / "b", "pass", steps=None, extra=afterwards(reads))
    assert (outcome["state"], outcome["stopped_by"]) == ("ok", "exit")


@pytest.mark.slow
def test_what_cannot_be_read_afterwards_says_why_and_a_crash_stays_one(tmp_path):
    outcome = run(tmp_path / "a", "pass", steps=None, extra=afterwards("raise SystemExit('the bag is damaged')"))
    assert (outcome["state"], outcome["reason"], outcome["detail"]) == ("failed", "no_response", "the bag is damaged")
    outcome = run(
        tmp_path / "b", "raise SystemExit('no camera')", steps=None, extra=afterwards("[say(1) for _ in range(3)]")
    )
    assert (outcome["reason"], outcome["requests"]) == ("crash", 3)


def test_reading_afterwards_has_an_end(tmp_path, monkeypatch):
    monkeypatch.setattr(sample, "AFTERWARDS_S", 0.3)
    monkeypatch.setattr(sample, "ARCHIVE", AGENT)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    limits = ["--out", str(tmp_path), "--after", "1", "--startup", "1", *afterwards("time.sleep(600)")]
    assert sample.main([*limits, "--process", '["true"]']) == 1
    detail = json.loads((tmp_path / "outcome.json").read_text())["detail"]
    assert detail == "nothing was timed within 0.3 s after the end"


def test_what_a_probe_notes_is_no_request_and_explains_why_there_is_none(tmp_path):
    script = """
with open(os.environ["FOGSPEC_TIMINGS"], "a") as f:
    f.write('{"note": "no node publishes /pose"}\\n{"warning": "x"}\\n{"metric": {"m": 1}, "at_s": 1}\\n{"unmatched": true}\\n')
"""
    outcome = run(tmp_path, script)
    assert outcome["detail"] == "the processes ended without one timed request: no node publishes /pose"
    assert (outcome["requests"], outcome["unreadable"]) == (0, 0)


ENOUGH = "import os; [0 for _ in iter(lambda: open(os.environ['FOGSPEC_TIMINGS']).read().count('plan') < 20, False)]"
MISSING = "print('/plan declares no parameter wrok'); raise SystemExit(3)"


@pytest.mark.parametrize(
    ("asks", "before", "state", "detail"),
    [
        (MISSING, "time.sleep(600)", "failed", "/plan declares no parameter wrok"),
        # There may have been enough requests before the nodes have answered.
        (f"{ENOUGH}; {MISSING}", "", "failed", "/plan declares no parameter wrok"),
        ("pass", "", "ok", None),
        ("print('no rclpy'); raise SystemExit(1)", "", "ok", sample.UNKNOWN),
    ],
)
def test_what_the_nodes_answer_decides_whether_the_sample_counts(tmp_path, asks, before, state, detail):
    extra = ["--asks", json.dumps([sys.executable, "-c", asks])]
    outcome = run(tmp_path, f"{before}\n{FOREVER}", extra=extra, startup=600.0)
    reason, stopped_by = ("not_reported", "startup") if state == "failed" else (None, "steps")
    assert [outcome[name] for name in ("state", "reason", "stopped_by", "detail")] == [
        state,
        reason,
        stopped_by,
        detail,
    ]


TALK = """
number = 0
while True:
    with open({path!r}, "a") as words: words.write(f"> {{number}}\\n")
    number += 1
    time.sleep(0.05)
"""
ANSWER = """
due, rest = [], ""
open({path!r}, "a").close()
heard = open({path!r})
while True:
    rest += heard.read()
    *lines, rest = rest.split("\\n")
    due += [(time.monotonic() + 0.2, line[2:]) for line in lines if line[0] == ">"]
    while due and due[0][0] <= time.monotonic():
        with open({path!r}, "a") as words: words.write(f"< {{due.pop(0)[1]}}\\n")
    time.sleep(0.005)
"""
# It joins when some are under way, and pairs in order what it hears; that the numbers agree is what is timed.
LISTEN = """
from fogspec_agent.holding import HELD, Held
from fogspec_agent.records import Writer
heard, writer, numbers, out = Held("/words"), Writer("/said"), {{}}, os.path.dirname(os.environ["FOGSPEC_TIMINGS"])
while not os.path.exists({path!r}) or open({path!r}).read().count("<") < 5: time.sleep(0.01)
words = open({path!r})
words.seek(0, 2)
words.readline()
rest = ""
while True:
    now_s = time.monotonic()
    rest += words.read()
    *lines, rest = rest.split("\\n")
    for line in lines:
        now_s += 1e-6
        if line[0] == ">":
            numbers[now_s] = line[2:]
            heard.take_request(None, now_s)
        elif (done := heard.take_response(None, now_s)) is not None:
            say(done.latency_s, ok=numbers[done.start_s] == line[2:])
    told = heard.look(now_s, os.path.exists(os.path.join(out, HELD)))
    told and writer.line(told)
    time.sleep(0.01)
"""


def held(tmp_path: Path, *scripts: str, **more):
    """A sample whose last process is the one that sends."""
    *others, sender = [TIMED + script.format(path=str(tmp_path / "words")) for script in scripts]
    given = [json.dumps([sys.executable, "-c", script]) for script in others]
    given.append(json.dumps({"argv": [sys.executable, "-c", sender], "name": "talk", "held": True}))
    return run(tmp_path, **more, extra=[word for one in given for word in ("--process", one)])


def test_a_sender_is_held_until_nothing_is_under_way_and_again_at_the_end(tmp_path):
    outcome = held(tmp_path, LISTEN, ANSWER, TALK, steps=30)
    assert (outcome["state"], outcome["stopped_by"]) == ("ok", "steps"), outcome
    lines = [json.loads(line) for line in (tmp_path / "out" / "timings.jsonl").read_text().splitlines()]
    assert [one["hold"] for one in lines if "hold" in one] == [True, False, False]
    assert lines[-1] == {"hold": False, "ended": True}
    assert all(one["ok"] for one in lines if "latency_s" in one)
    with open(tmp_path / "out" / "timings.jsonl", "rb") as file:
        assert parse_requests(file, RecordRules(warmup=1, valid=0.95, statistic="mean")).unreadable == 0
    assert not (tmp_path / "out" / "held").exists()


def test_what_a_listener_refuses_is_not_measured(tmp_path):
    outcome = held(tmp_path, LISTEN, ANSWER, TALK, TALK, steps=30)
    assert (outcome["state"], outcome["reason"]) == ("failed", "not_reported")
    assert "requests on /words come while the workload is held" in outcome["detail"]


def test_without_a_sender_to_hold_nothing_in_the_timings_holds_or_refuses(tmp_path):
    asks = """
with open(os.environ["FOGSPEC_TIMINGS"], "a") as f: f.write(json.dumps({"hold": True, "refused": "no"}) + "\\n")
"""
    assert run(tmp_path, asks + FOREVER)["state"] == "ok"
    assert not (tmp_path / "out" / "held").exists()


def test_a_sender_that_is_held_when_the_sample_ends_is_ended(tmp_path):
    wants = f"""
while not (os.path.exists({str(tmp_path / "pid")!r}) and open({str(tmp_path / "pid")!r}).read()): time.sleep(0.01)
with open(os.environ["FOGSPEC_TIMINGS"], "a") as f: f.write(json.dumps({{{{"hold": True}}}}) + "\\n")
while not os.path.exists(os.path.join(os.path.dirname(os.environ["FOGSPEC_TIMINGS"]), "held")): time.sleep(0.01)
raise SystemExit("the listener ends")
"""
    pid = f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(3600)"
    outcome = held(tmp_path, wants, pid, startup=600.0)
    assert (outcome["reason"], "the listener ends" in outcome["detail"]) == ("crash", True)
    assert not Path("/proc", (tmp_path / "pid").read_text()).exists()


def test_silence_is_told_with_what_tf_said(tmp_path):
    outcome = run(
        tmp_path, "print('[planner] Lookup would require extrapolation into the past.', flush=True); print('bye')"
    )
    assert outcome["reason"] == "no_response"
    assert "[planner] Lookup would require extrapolation into the past." in outcome["detail"]


@pytest.mark.parametrize(
    ("theirs", "said"),
    [
        ({"ROS_DOMAIN_ID": "7"}, None),
        ({"ROS_DOMAIN_ID": "119", "FOGSPEC_COMMAND": "planner"}, "planner has ROS_DOMAIN_ID 119, and the sample 7"),
        ({"FOGSPEC_COMMAND": "no ROS"}, None),
        ({"FOGSPEC_COMMAND": "b", "AMENT_PREFIX_PATH": "/opt/ros"}, "b has ROS_DOMAIN_ID none, and the sample 7"),
        (
            {"ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_x", "FOGSPEC_COMMAND": "b"},
            "b has RMW_IMPLEMENTATION rmw_x, and",
        ),
    ],
)
def test_a_process_in_another_graph_is_named(monkeypatch, theirs, said):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, env=theirs) as child:
        while not Path(f"/proc/{child.pid}/environ").read_bytes():
            time.sleep(0.01)  # a process in exec has none for a moment
        monkeypatch.setattr(sample.processes, "descendants", lambda: [2**30, child.pid])
        found = sample.SampleRun._elsewhere(SimpleNamespace(environment={"ROS_DOMAIN_ID": "7"}))
    assert (found or "").startswith(said or "")
    assert (found is None) == (said is None)
