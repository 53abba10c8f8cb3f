"""Confinement holds: CPUs for every descendant, memory, and an end for all of the session."""

import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

import fogspec
from fogspec.backends.local import limits
from fogspec.base import host

ALL = sorted(os.sched_getaffinity(0))


def run(
    tmp_path: Path, script: str, cpus: int = 1, memory_gib: float = 1.0, **more
) -> tuple[limits.LimitedProcess, Path]:
    log = tmp_path / "log"
    words = [sys.executable, "-c", script]
    with open(log, "ab") as file:
        started = limits.start(
            words,
            cpus=cpus,
            memory_gib=memory_gib,
            cwd=tmp_path,
            env=dict(os.environ),
            log=file,
            name=f"fogspec-{time.time_ns()}",
            **{"grace_s": 0.0, **more},
        )
    return started, log


def ended(started: limits.LimitedProcess) -> int:
    code = started.process.wait(600)
    started.end()
    return code


@pytest.mark.parametrize("cpus", range(1, min(len(ALL), 4) + 1))
def test_a_grandchild_sees_just_so_many_cpus(tmp_path, cpus):
    script = "import os, subprocess; subprocess.run(['nproc'], env={'PATH': os.environ['PATH']})"
    started, log = run(tmp_path, script, cpus=cpus)
    assert ended(started) == 0
    assert log.read_text().strip() == str(cpus)
    assert len(set(started.cpus)) == cpus
    assert sorted(os.sched_getaffinity(0)) == ALL


def test_more_cpus_than_there_are_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="CPUs were requested"):
        run(tmp_path, "pass", cpus=len(ALL) + 1)


def test_distinct_cores_come_before_siblings(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3, 4, 5})
    monkeypatch.setattr(limits, "_core", lambda cpu: f"core {cpu // 2}")
    assert limits.pick_cpus(3) == (0, 2, 4)
    assert limits.pick_cpus(4) == (0, 1, 2, 4)


HOG = "kept = []\nwhile True: kept.append(bytearray(2**24)); kept[-1][::4096] = b'x' * 4096"


@pytest.mark.slow
def test_memory_is_bounded_and_the_bound_is_the_one_asked_for(tmp_path):
    fits, _ = run(tmp_path, "x = bytearray(2**27)", memory_gib=0.5)
    assert ended(fits) == 0
    hog, log = run(tmp_path, HOG, memory_gib=0.5)
    code = hog.process.wait(600)
    if hog.memory_by == "rlimit":
        assert code == 1
        assert log.read_text().splitlines()[-1] == "MemoryError"
    else:
        assert code == 128 + 9
        assert hog.outcome() == "out_of_memory"
    hog.end()


def test_ending_asks_first_then_ends_the_whole_session(tmp_path):
    script = """
import os, signal, time
signal.signal(signal.SIGTERM, lambda *_: (print("asked", flush=True), os._exit(3)))
child = os.fork()
if child == 0:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(600)
print(child, "ready", flush=True)
while True:  # Python runs a handler between two sleeps: one that comes right before a long sleep would wait for its end.
    time.sleep(0.05)
"""
    # Longer than a test may take: it ends because it was asked to, not for want of patience.
    started, log = run(tmp_path, script, grace_s=3600.0)
    while "ready" not in (log.read_text() if log.exists() else ""):
        time.sleep(0.02)
    started.end()
    started.end()
    assert started.poll() == 3
    assert "asked" in log.read_text()
    child = int(log.read_text().split()[0])
    until = time.monotonic() + 1200
    while alive(child) and time.monotonic() < until:
        time.sleep(0.02)
    assert not alive(child)


def alive(pid: int) -> bool:
    """Whether it runs: whoever adopted it may not have buried it yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def without_cgroups(monkeypatch) -> None:
    monkeypatch.setattr(limits, "_new_group", lambda _name, _bytes: (None, False))


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(
    ("script", "code"),
    [("exit 0", 0), ("exit 7", 7), ("kill -9 $$", 128 + 9), ("exec /missing", 127)],
)
def test_the_exit_code_is_the_programs(tmp_path, monkeypatch, apart, script, code):
    without_cgroups(monkeypatch)
    started, _ = run(tmp_path, f"import os; os.execv('/bin/sh', ['sh', '-c', {script!r}])", apart=apart)
    assert ended(started) == code


def test_a_program_that_is_none_is_said_and_leaves_no_launcher(tmp_path, monkeypatch):
    without_cgroups(monkeypatch)
    (tmp_path / "log").touch()
    with open(tmp_path / "log", "ab") as file:
        started = limits.start(["/missing/program"], cpus=1, memory_gib=1.0, cwd=tmp_path, env={}, log=file,
                               name="fogspec-x", grace_s=0.0)  # fmt: skip
    assert ended(started) == 126
    log = (tmp_path / "log").read_text()
    assert log == ("fogspec: /missing/program cannot be started: [Errno 2] No such file or directory\n")


def test_what_the_program_leaves_behind_ends_with_it(tmp_path, monkeypatch):
    without_cgroups(monkeypatch)
    script = "import subprocess; print(subprocess.Popen(['sleep', '600'], start_new_session=True, env={}).pid)"
    started, log = run(tmp_path, script)
    assert started.process.wait(600) == 0
    assert not alive(int(log.read_text()))


def test_a_program_that_does_not_end_is_killed_after_its_grace(tmp_path, monkeypatch):
    without_cgroups(monkeypatch)
    ignores = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); time.sleep(600)"
    started, log = run(tmp_path, ignores, grace_s=0.2)
    while "ready" not in log.read_text():
        time.sleep(0.02)
    started.process.terminate()
    assert started.process.wait(600) == 128 + 9


SEES = """
import os, subprocess
pids = [int(name) for name in os.listdir("/proc") if name.isdigit()]
print(os.getpid() in pids, max(pids) < 10, os.getuid(), os.getgid(), os.listdir("/dev/shm"))
try:
    with open("/dev/shm/own", "wb") as file:
        for _ in range(65): file.write(bytes(2**20)); file.flush()
except OSError as problem:
    print(problem.strerror)
"""


def test_in_namespaces_it_sees_only_its_own_processes_and_shared_memory_of_limited_size(tmp_path, monkeypatch):
    if not limits.has_namespaces():
        pytest.skip("this host has no namespaces for it")
    without_cgroups(monkeypatch)
    started, log = run(tmp_path, SEES, memory_gib=1 / 16, apart=True)
    assert ended(started) == 0
    assert log.read_text().splitlines() == [f"True True {os.getuid()} {os.getgid()} []", "No space left on device"]
    assert not Path("/dev/shm/own").exists()
    assert started.memory_by == limits.memory_by() == "namespace"


def test_in_namespaces_all_ends_with_the_launcher_even_if_it_is_killed(tmp_path, monkeypatch):
    if not limits.has_namespaces():
        pytest.skip("this host has no namespaces for it")
    without_cgroups(monkeypatch)
    (tmp_path / "lock").touch()
    script = """
import fcntl, os, subprocess, time
lock = os.open("lock", os.O_RDWR); fcntl.flock(lock, fcntl.LOCK_EX)
subprocess.Popen(["sleep", "600"], start_new_session=True, env={}, pass_fds=[lock])
print("ready", flush=True); time.sleep(600)
"""
    started, log = run(tmp_path, script, apart=True)
    while "ready" not in log.read_text():
        time.sleep(0.02)
    started.process.kill()
    with open(tmp_path / "lock", "rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # all who have it open have ended


# The interpreter of these tests need not be readable for others.
SYSTEM_PYTHON = "/usr/bin/python3"


@pytest.mark.skipif(
    os.getuid() != 0 or not os.path.exists(SYSTEM_PYTHON),
    reason="needs root, to be another user, and a Python for all users",
)
def test_a_user_without_rights_gets_namespaces_where_unshare_gets_them():
    nobody = {"user": 65534, "group": 65534, "extra_groups": [], "cwd": "/"}
    words = ["unshare", "--map-current-user", "--pid", "--fork", "--mount-proc", "true"]
    allowed = subprocess.run(words, **nobody, capture_output=True).returncode == 0
    package = Path(fogspec.__file__).parent
    with tempfile.TemporaryDirectory() as folder:
        # Neither the checkout nor pytest's folder need be readable for others.
        os.chmod(folder, 0o755)
        shutil.copytree(package, Path(folder, "fogspec"), ignore=shutil.ignore_patterns("__pycache__"))
        script = f"import sys; sys.path.append({folder!r}); from fogspec.backends.local import limits; "
        words = [SYSTEM_PYTHON, "-c", script + "print(limits.has_namespaces())"]
        asked = subprocess.run(words, **nobody, capture_output=True)
    assert (asked.stdout.decode(), asked.stderr.decode()) == (f"{allowed}\n", "")


def test_what_cannot_be_started_leaves_nothing(tmp_path):
    with pytest.raises(FileNotFoundError):
        run(tmp_path / "missing", "pass")


def hierarchy(tmp_path: Path, monkeypatch, lines: str, files: dict[str, str]) -> None:
    """A made-up /sys/fs/cgroup, since a machine has one kind only."""
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    real = host.text
    monkeypatch.setattr(host, "CGROUPS", tmp_path)
    monkeypatch.setattr(host, "text", lambda path: lines if str(path) == "/proc/self/cgroup" else real(path))


def test_capacity_is_the_smallest_limit_on_the_way_up(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    files = {
        "a/cpu.max": "350000 100000",
        "a/b/cpu.max": "max 100000",
        "a/memory.max": "1073741824",
        "a/b/memory.max": "max",
    }
    hierarchy(tmp_path, monkeypatch, "0::/a/b", files)
    assert host.capacity() == (3, 1.0)


def test_capacity_reads_limits_of_version_1(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    files = {"cpu/x/cpu.cfs_quota_us": "50000\n", "cpu/x/cpu.cfs_period_us": "100000\n",
             "memory/memory.limit_in_bytes": "536870912\n"}  # fmt: skip
    hierarchy(tmp_path, monkeypatch, "3:cpu:/x\n2:memory:/seen/only/outside\n0::/", files)
    assert host.capacity() == (1, 0.5)


def test_a_folder_without_memory_controller_is_no_cgroup(tmp_path, monkeypatch):
    hierarchy(tmp_path, monkeypatch, "0::/a", {"a/cgroup.procs": "", "cgroup.procs": ""})
    assert limits.memory_by() in ("namespace", "rlimit")
    assert sorted(path.name for path in tmp_path.rglob("fogspec-*")) == []


def test_the_launcher_imports_nothing_from_the_folder_of_the_spec(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    for name in ("resource", "os", "sitecustomize", "usercustomize", "encodings"):
        (tmp_path / f"{name}.py").write_text(f"open({str(mark)!r}, 'a').close()\n")
    with open(tmp_path / "log", "ab") as file:
        started = limits.start(
            ["pwd"],
            cpus=1,
            memory_gib=1.0,
            cwd=tmp_path,
            env={"PYTHONPATH": f":.:{tmp_path}"},
            log=file,
            name="fogspec-x",
            grace_s=0.0,
        )
    assert ended(started) == 0
    assert (tmp_path / "log").read_text().strip() == str(tmp_path)
    assert not mark.exists()


@pytest.mark.slow
def test_two_jobs_have_cpus_of_their_own_while_there_are_some(tmp_path, monkeypatch):
    """A third shares one, and a CPU is free again with the end of all that a job started, however it ended."""
    with limits.claimed_cpus(1) as (_, claims):
        assert len(claims) <= 1, "the kernel's own files may be all taken"
    for cpu in ALL:
        (tmp_path / f"cpu{cpu}").touch()
    monkeypatch.setattr(limits, "CLAIM", f"{tmp_path}/cpu{{}}")
    monkeypatch.setattr(limits, "_in_turn", lambda _: ALL[:2])
    jobs = [run(tmp_path, "import time; print('up', flush=True); time.sleep(600)")[0] for _ in range(len(ALL[:2]) + 1)]
    *apart, third = (one.cpus for one in jobs)
    assert sorted(apart) == [(cpu,) for cpu in ALL[:2]]
    assert third[0] in ALL[:2]
    os.killpg(jobs[0].process.pid, 9)
    jobs[0].process.wait(60)
    jobs[0].end()
    again, _ = run(tmp_path, "pass")
    assert again.cpus == jobs[0].cpus
    for one in (again, *jobs[1:]):
        one.end()
