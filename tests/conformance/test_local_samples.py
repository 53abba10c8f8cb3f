"""The local backend keeps what the protocol promises: a name is enough to find, look at and end a sample."""

import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fogspec.backends.local import backend as local
from fogspec.backends.local import limits, processes
from fogspec.backends.local.backend import MARK, LocalDeployments, LocalSamples, mark_of
from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job, LaunchRefused, SampleStatus
from fogspec.catalog.machine import Machine
from tests.support.agent import AGENT
from tests.support.jobs import job_of

RUN = """exec python3 "$FOGSPEC_AGENT" sample --out "$FOGSPEC_OUT" \\
  --after 600 --startup 120 --warmup 1 --steps {steps} --process {argv}
"""
PROBED = """
import fogspec_probe, os, time
while True:
    fogspec_probe.start("plan"); time.sleep(0.01); fogspec_probe.stop("plan", cpus=len(os.sched_getaffinity(0)))
"""

OWNER = Owner("a repository", "default", "demo")


def job(folder: Path, script: str = PROBED, steps: int = 5, cpus: float = 1, memory_gib: float = 1, **task) -> Job:
    shape = f"{cpus:g}cpu-{memory_gib:g}gib"
    machine = Machine.model_construct(infra="local", instance=shape, cpus=cpus, memory=memory_gib, gpu=None,
                                         spot=False, price=0.0)  # fmt: skip
    (folder / "workload.py").write_text(script)
    argv = json.dumps(["python3", str(folder / "workload.py")])
    shutil.copy(AGENT, folder)
    mounts = {"~/.fogspec/agent.pyz": AGENT.name}
    task = {"run": RUN.format(steps=steps, argv=f"'{argv}'"), "workdir": ".", "file_mounts": mounts} | task
    name = f"{OWNER.prefix}test-{os.getpid()}-{time.monotonic_ns()}"
    directory = folder / "attempts" / name
    return job_of(folder, task, name=name, owner=OWNER, machine=machine, directory=directory, lifetime_s=900.0)


def until(backend: LocalSamples, asked: Job, what, patience_s: float = 1200.0) -> SampleStatus:
    end = time.monotonic() + patience_s
    while not what(progress := backend.poll(asked)):
        assert time.monotonic() < end, progress
        time.sleep(0.05)
    return progress


def over(progress: SampleStatus) -> bool:
    return not progress.running


@pytest.fixture
def backend():
    return LocalSamples()


def test_a_sample_is_measured_on_its_cpus_and_any_process_says_the_same_of_it_ever_after(tmp_path, backend):
    asked = job(tmp_path)
    backend.start(asked)
    done = until(backend, asked, over)
    assert (done.reason, done.stopped_by, done.measured_on, done.lost) == (None, "steps", "local/1cpu-1gib", False)
    lines = map(json.loads, done.timings.read_text().splitlines())
    records = [record for record in lines if "latency_s" in record]  # the first start of each name has a line too
    assert len(records) >= 6
    assert {record["metrics"]["cpus"] for record in records} == {1.0}
    backend.stop(asked)
    backend.stop(asked)
    assert backend.poll(asked) == done
    assert LocalSamples().poll(asked) == done
    assert processes.marked(MARK, mark_of(asked)) == []


def test_ending_early_leaves_what_was_measured_and_no_process(tmp_path, backend):
    asked = job(tmp_path, steps=100_000)
    backend.start(asked)
    measuring = until(backend, asked, lambda progress: progress.ready and progress.timings.stat().st_size > 500)
    assert measuring.running
    backend.stop(asked)
    assert processes.marked(MARK, mark_of(asked)) == []
    after = backend.poll(asked)
    assert (after.running, after.reason) == (False, "interrupted")
    assert after.timings.read_text().endswith("\n")


def test_background_grandchildren_that_ignore_signals_are_ended(tmp_path, backend, monkeypatch):
    monkeypatch.setattr(local, "GRACE_S", 1.0)
    stubborn = """
import os, signal, time, fogspec_probe
ready, left = os.pipe()
if os.fork() == 0:
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, signal.SIG_IGN)
    if os.fork() == 0:
        open("stubborn", "w").close()
        os.write(left, b".")
        time.sleep(600)
    os._exit(0)
os.read(ready, 1)  # it has left the session and ignores signals
fogspec_probe.start("plan"); fogspec_probe.stop("plan"); os._exit(0)
"""
    # Not even the agent is there to tidy up.
    asked = job(tmp_path, run=f"PYTHONPATH=$FOGSPEC_AGENT exec {sys.executable} workload.py", script=stubborn)
    backend.start(asked)
    until(backend, asked, over)
    assert (tmp_path / "stubborn").exists()
    assert processes.marked(MARK, mark_of(asked)) == [], "they end with the program, before anybody asks for it"
    backend.stop(asked)
    assert processes.marked(MARK, mark_of(asked)) == []


def scanned(word: str) -> list[int]:
    """Living processes with this word on their command line, whatever else they dropped."""
    found = []
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            if word.encode() in Path("/proc", entry, "cmdline").read_bytes().split(b"\0"):
                found.append(int(entry))
    return found


# Each ends once it has started the next, in a session of its own and without the job's name; all end after two minutes.
CHAIN = """
import os, signal, sys, time
end_s = time.monotonic() + 1200
beats = os.open("beats", os.O_WRONLY | os.O_APPEND)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.SIG_IGN)
while time.monotonic() < end_s:
    if os.fork():
        os._exit(0)
    os.setsid()
    os.write(beats, b".")
"""
# The lock belongs to all who have the file open: nobody else gets it before the last of them has ended.
DROPS_ITS_NAME = """
import fcntl, fogspec_probe, os, signal, subprocess, sys, time
lock = os.open("lock", os.O_RDWR)
fcntl.flock(lock, fcntl.LOCK_EX)
kept = open("/dev/shm/{word}", "wb"); kept.write(b"x" * 4096); kept.flush()
for _ in range(3):
    subprocess.Popen([sys.executable, "-S", "chain.py", "{word}"], env={{}}, start_new_session=True, pass_fds=[lock])
fogspec_probe.start("plan"); fogspec_probe.stop("plan")
while os.path.getsize("beats") < 30: time.sleep(0.01)
{then}
time.sleep(600)
"""
KILLS_THE_AGENT = "os.kill(os.getppid(), 9)"
KILLS_ALL_ABOVE = """
for _ in range(9):
    with open(f"/proc/{os.getppid()}/stat") as file:
        above = int(file.read().rsplit(")", 1)[1].split()[1])
    if above in (0, 1) or b"fogspec.backends.local.launcher" not in open(f"/proc/{above}/cmdline", "rb").read(): break
    os.kill(above, 9)
os.kill(os.getppid(), 9)
"""


def is_locked(path: Path) -> bool:
    with open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def end_chains(word: str, lock: Path) -> None:
    """Kill what outlived its sample: it would slow down every other test."""
    until_s = time.monotonic() + 600
    while is_locked(lock) and time.monotonic() < until_s:
        for pid in sorted(scanned(word), reverse=True):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def backend_ends_by() -> str:
    group, _ = limits._new_group(f"{limits.GROUP}test-{time.monotonic_ns()}", 2**30)
    if group:
        limits.end_group(group)
        return "cgroup"
    return "namespace" if limits.has_namespaces() else "launcher"


@pytest.mark.parametrize(
    ("by", "then"),
    [
        ("cgroup", ""),
        ("cgroup", KILLS_THE_AGENT),
        ("cgroup", KILLS_ALL_ABOVE),
        ("namespace", ""),
        ("namespace", KILLS_THE_AGENT),
        ("namespace", KILLS_ALL_ABOVE),
        ("launcher", ""),
        ("launcher", KILLS_THE_AGENT),
    ],
    ids=lambda word: {"": "agent", KILLS_THE_AGENT: "no-agent", KILLS_ALL_ABOVE: "no-launcher"}.get(word, word),
)
def test_chains_of_processes_that_drop_everything_are_ended(tmp_path, backend, monkeypatch, by, then):
    if by != "cgroup":
        monkeypatch.setattr(limits, "_new_group", lambda _name, _bytes: (None, False))
    if by == "launcher":
        monkeypatch.setattr(limits, "has_namespaces", lambda: False)
    if then == KILLS_ALL_ABOVE and backend_ends_by() != by:
        pytest.skip(f"this host has no {by} for it")
    monkeypatch.setattr(local, "GRACE_S", 1.0 if then else 10.0)
    word = f"fogspec-test-{time.monotonic_ns()}"
    (tmp_path / "chain.py").write_text(CHAIN)
    for name in ("beats", "lock"):
        (tmp_path / name).touch()
    asked = job(tmp_path, script=DROPS_ITS_NAME.format(word=word, then=then), steps=100_000)
    backend.start(asked)
    lock, shared = tmp_path / "lock", Path("/dev/shm", word)
    others = Path("/dev/shm", f"{word}-of-others")
    try:
        until(backend, asked, lambda _: (tmp_path / "beats").stat().st_size >= 30)
        others.write_bytes(b"kept")
        backend.stop(asked)
        assert not is_locked(lock), "a process of the chains runs"
        assert scanned(word) == []
        assert processes.marked(MARK, mark_of(asked)) == []
        assert not shared.exists(), "a killed node does not remove its shared memory"
        assert others.exists(), "what no process of the sample used is not touched"
        assert limits.groups(local.group_of(asked)) == []
    finally:
        others.unlink(missing_ok=True)
        end_chains(word, lock)


@pytest.mark.parametrize(
    ("kind", "by"),
    [
        (LocalDeployments, "cgroup"),
        (LocalDeployments, "launcher"),
        (LocalSamples, "namespace"),
        (LocalSamples, "launcher"),
    ],
    ids=lambda one: one if isinstance(one, str) else one.__name__,
)
@pytest.mark.parametrize("then", ["", KILLS_THE_AGENT], ids=["agent", "no-agent"])
def test_chains_are_ended_by_the_jobs_name_alone(tmp_path, monkeypatch, kind, by, then):
    if by != "cgroup":
        monkeypatch.setattr(limits, "_new_group", lambda _name, _bytes: (None, False))
    if by == "launcher":
        monkeypatch.setattr(limits, "has_namespaces", lambda: False)
    word = f"fogspec-test-{time.monotonic_ns()}"
    (tmp_path / "chain.py").write_text(CHAIN)
    for name in ("beats", "lock"):
        (tmp_path / name).touch()
    run = f"""exec python3 "$FOGSPEC_AGENT" supervisor --out "$FOGSPEC_OUT" --process '["python3", "{tmp_path}/workload.py"]'"""
    asked = job(tmp_path, script=DROPS_ITS_NAME.format(word=word, then=then), run=run)
    lock, starter = tmp_path / "lock", kind()
    starter.start(asked)
    try:
        until_s = time.monotonic() + 1200
        while (tmp_path / "beats").stat().st_size < 30:
            assert time.monotonic() < until_s
            time.sleep(0.05)
        kind().stop(asked)
        assert not is_locked(lock), "a process of the chains runs"
        assert processes.marked(MARK, mark_of(asked)) == []
        assert not Path("/dev/shm", word).exists()
        assert limits.groups(local.group_of(asked)) == []
    finally:
        end_chains(word, lock)


def test_a_memory_hog_is_recorded_as_out_of_memory_from_any_process(tmp_path, backend):
    hog = "kept = []\nwhile True: kept.append(bytearray(2**24)); kept[-1][::4096] = b'x' * 4096"
    asked = job(tmp_path, script=hog, memory_gib=0.25)
    backend.start(asked)
    done = until(backend, asked, over)
    assert done.reason == "out_of_memory"
    assert done.detail.startswith("0.25 GiB were not enough: python3 ")
    backend.stop(asked)
    assert LocalSamples().poll(asked) == done


CONTROLLER = """
import os, pickle, sys
from fogspec.backends.naming import Owner
from fogspec.backends.local.backend import LocalSamples
LocalSamples().start(pickle.load(open(sys.argv[1], "rb")))
os.kill(os.getpid(), 9)
"""


def killed_controller(tmp_path: Path, asked: Job) -> None:
    import pickle

    (tmp_path / "job").write_bytes(pickle.dumps(asked))
    ended = subprocess.run([sys.executable, "-c", CONTROLLER, str(tmp_path / "job")], timeout=600)
    assert ended.returncode == -9


def test_a_sample_outlives_a_killed_controller_and_is_recovered(tmp_path, backend):
    asked = job(tmp_path, steps=30)
    killed_controller(tmp_path, asked)
    done = until(backend, asked, over)
    assert (done.reason, done.stopped_by, done.lost) == (None, "steps", False)
    backend.stop(asked)


def test_a_sample_of_a_killed_controller_can_be_ended_by_name(tmp_path, backend):
    asked = job(tmp_path, steps=100_000)
    killed_controller(tmp_path, asked)
    until(backend, asked, lambda progress: progress.running and progress.ready)
    backend.stop(asked)
    assert processes.marked(MARK, mark_of(asked)) == []
    assert backend.poll(asked).reason == "interrupted"


def test_what_ignores_its_signal_is_killed_also_when_all_the_time_for_it_has_passed(monkeypatch):
    monkeypatch.setattr(processes, "KILL_S", 0.0)
    word = str(time.monotonic_ns())
    ignores = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); signal.pause()"
    environment = {**os.environ, "FOGSPEC_TEST": word}
    with subprocess.Popen([sys.executable, "-c", ignores], env=environment, stdout=subprocess.PIPE) as started:
        started.stdout.readline()
        try:
            assert processes.end(lambda: set(processes.marked("FOGSPEC_TEST", word)), 0.0) == []
        finally:
            started.kill()


def test_a_sample_that_was_never_started_or_lost_everything_is_lost(tmp_path, backend):
    asked = job(tmp_path)
    assert backend.poll(asked).lost
    backend.stop(asked)
    assert backend.poll(asked).lost


def test_a_run_script_that_fails_says_what_it_said(tmp_path, backend):
    asked = job(tmp_path, run="echo no such thing >&2; exit 4")
    backend.start(asked)
    done = until(backend, asked, over)
    assert (done.reason, done.detail) == ("setup", "the run script ended with exit code 4: no such thing")


@pytest.mark.parametrize(
    "wrong", [{"cpus": 4096}, {"memory_gib": 2.0**20}, {"workdir": "missing"}, {"secrets": {"FOGSPEC_NOT_SET": None}}]
)
def test_what_this_host_cannot_do_is_said_and_leaves_nothing(tmp_path, backend, wrong):
    asked = job(tmp_path, **wrong)
    with pytest.raises(LaunchRefused) as no:
        backend.start(asked)
    assert no.value.reason in ("capacity", "setup")
    assert not no.value.again
    backend.stop(asked)
    assert processes.marked(MARK, mark_of(asked)) == []


KEPT_BACK = (
    "AWS_SECRET_ACCESS_KEY",
    "OPENAI_KEY",
    "GITHUB_PAT",
    "KUBECONFIG",
    "ROS_API_KEY",
    "OPENBLAS_NUM_THREADS",
    "MINE",
)
GIVEN = (
    "ROS_DOMAIN_ID",
    "RMW_IMPLEMENTATION",
    "AMENT_PREFIX_PATH",
    "CYCLONEDDS_URI",
    "LC_ALL",
    "CUDA_VISIBLE_DEVICES",
    "HOME",
)


def test_the_environment_is_what_ros_needs_and_what_the_spec_names(tmp_path, backend, monkeypatch):
    for name in (*KEPT_BACK, *GIVEN, "MY_TOKEN", "OMP_NUM_THREADS"):
        monkeypatch.setenv(name, "from the shell")
    asked = job(tmp_path, run="env", secrets={"MY_TOKEN": None}, envs={"OMP_NUM_THREADS": 1})
    backend.start(asked)
    until(backend, asked, over)
    backend.stop(asked)
    said = dict(line.partition("=")[::2] for line in (asked.directory / "run.log").read_text().splitlines())
    assert not said.keys() & set(KEPT_BACK)
    assert (said["MY_TOKEN"], said["OMP_NUM_THREADS"]) == ("from the shell", "1")
    assert {said[name] for name in GIVEN} == {"from the shell"}
    assert said[MARK] == mark_of(asked)
    assert said["PATH"] == f"{os.environ['PATH']}:{Path(sys.executable).parent}", "this Python is the last"


def test_the_source_says_what_was_emulated_and_how(backend):
    assert "by affinity" in backend.source
    assert "by cgroup" in backend.source or "by rlimit of each process (shared memory is not limited)" in backend.source
    assert "CPUs by affinity, memory by" in backend.notes[0]
    assert "name it in spec.secrets" in backend.notes[1]
