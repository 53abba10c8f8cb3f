"""The reader of resources, on files as kernels and nvidia-smi write them, and on this computer."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fogspec.agent import processes, resources

CSV = """\
0, 87, 2048, 15360
1, [N/A], [N/A], 81559
NVIDIA-SMI has failed because it couldn't communicate with the NVIDIA driver.
2, 0, 3, 15360, 9
-1, 5, 5, 5
3, 101, 1, 15360
"""
V1 = "9:name=systemd:/\n4:memory:/m\n2:cpuacct,cpu:/pod/one\n0::/\n"


def test_gpus_are_read_from_the_lines_that_are_theirs() -> None:
    rows = resources.gpu_rows(CSV)
    assert rows == [
        resources.GpuRow(0, 0.87, 2048.0, 15360.0),
        resources.GpuRow(1, None, None, 81559.0),
        resources.GpuRow(3, 1.0, 1.0, 15360.0),
    ]
    assert resources.gpu_rows("") == []


def smi(tmp_path: Path, lines: str, then: str = "exec sleep 600") -> str:
    path = tmp_path / "nvidia-smi"
    path.write_text(f"#!/bin/sh\nprintf '{lines}'\n{then}\n")
    path.chmod(0o755)
    return str(path)


def test_gpus_are_asked_in_a_loop_and_the_program_ends_with_the_sample(tmp_path: Path) -> None:
    reader = resources.GpuReader(
        [str(tmp_path / "absent"), smi(tmp_path, "0, 50, 1024, 4096\\n0, 70, 2048, 4096\\n0, 9")]
    )
    found = resources.Resources(reader)
    end_s = time.monotonic() + 600
    rows: list[resources.GpuRow] = []
    while len(rows) < 2 and time.monotonic() < end_s:
        rows += reader.read()
    for row in rows:
        found._take(row)
    assert found._gpu_facts() == {
        "gpus": 1, "gpu_mean": 0.6, "gpu_max": 0.7, "gpu_memory_peak": 2.0, "gpu_memory": 4.0,
    }  # fmt: skip
    (pid,) = reader.pids()
    assert found.end() is None, "no window was begun"
    assert not Path(f"/proc/{pid}").exists()
    found.end()


def test_a_program_that_fails_or_is_absent_leaves_no_figures(tmp_path: Path) -> None:
    reader = resources.GpuReader([smi(tmp_path, "No devices were found\\n", "exit 6")])
    assert reader.process is not None
    reader.process.wait(600)
    assert reader.read() == []
    reader.close()
    assert resources.Resources(resources.GpuReader([]))._gpu_facts() == {}


def reading(at_s: float, cpu_s: float, **changed: object) -> resources.Reading:
    return resources.Reading(**{
        "at_s": at_s, "cpu_s": cpu_s, "minor_faults": 0, "major_faults": 0, "resident_bytes": 2**30, "swapped_bytes": 0,
        "received_bytes": 0, "sent_bytes": None, "periods": {}, **changed,
    })  # fmt: skip


def test_a_window_has_the_mean_and_the_largest_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readings = [
        reading(10.0, 5.0, periods={"pod": (100, 10), "node": (50, 0)}),
        reading(11.0, 6.0, resident_bytes=3 * 2**30),
        reading(12.0, 9.5),
        reading(12.2, 9.5, minor_faults=7, swapped_bytes=2**20, periods={"pod": (200, 60), "node": (150, 0)}),
    ]
    seconds = iter(one.at_s for one in readings)
    pending = iter(readings)
    monkeypatch.setattr(resources, "read", lambda _now, _but: next(pending))
    monkeypatch.setattr(resources, "usable_vcpus", lambda: 4.0)
    (tmp_path / "meminfo").write_text("MemTotal: 4194304 kB\nMemFree: 1 kB\nMemAvailable:  3145728 kB\n")
    monkeypatch.setattr(resources, "PROC", tmp_path)
    monkeypatch.setattr(resources.time, "monotonic", lambda: next(seconds))
    found = resources.Resources(resources.GpuReader([]))
    found.begin()
    found.look()
    found.look()
    facts = found.end()
    assert facts is not None
    assert facts.pop("overhead") >= 0
    assert facts == {
        "window": 2.2, "vcpus": 4.0, "cpu_mean": 2.045, "cpu_max": 3.5, "throttled": 0.5, "memory_peak": 3.0,
        "memory_before": 1.0,
        "minor_faults": 7, "major_faults": 0, "swapped": 0.0009766, "received": 0.0,
    }  # fmt: skip


STAT = """\
cpu  9000 9 900 90000 90 90 90 900 5 5
cpu0 {own} 0 100 5000 10 {irq} 0 {stolen} 0 0
cpu1 {own} 5 100 5000 10 0 0 0 0 0
cpu10 7000 0 0 5000 0 0 0 0 0 0
intr 1 2 3
"""
PROCESS = "{pid} (a b) S 1 1 1 0 -1 0 0 0 0 0 {user} {system} 0 0 20 0 9 0 1 2 3 4"


def test_what_others_and_the_host_took_is_told_from_the_samples_own_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine threads that wait for one another are the sample's; the agent, another CPU and interrupts do not count."""

    def outside(own: int, irq: int, stolen: int, agent: int, sample: int) -> float | None:
        for name, text in (("self", PROCESS.format(pid=6, user=agent, system=0)),
                           ("7", PROCESS.format(pid=7, user=sample, system=sample))):  # fmt: skip
            (tmp_path / name).mkdir(exist_ok=True)
            (tmp_path / name / "stat").write_text(text)
        (tmp_path / "stat").write_text(STAT.format(own=own, irq=irq, stolen=stolen))
        return resources.read(0.0).outside_s

    monkeypatch.setattr(resources, "PROC", tmp_path)
    monkeypatch.setattr(resources.processes, "tree", lambda: {7})
    monkeypatch.setattr(resources.os, "sysconf", lambda _name: 100)
    monkeypatch.setattr(resources.os, "sched_getaffinity", lambda _pid: {0, 1})
    first = outside(1000, 0, 0, 0, 0)
    assert first is not None
    assert outside(2000, 500, 0, 100, 950) == pytest.approx(first), (
        "20 s of two CPUs: 19 of the sample, one of the agent"
    )
    assert outside(2000, 500, 50, 100, 800) == pytest.approx(first + 3.5)
    monkeypatch.setattr(resources.os, "sched_getaffinity", lambda _pid: {0, 3})
    assert outside(1000, 0, 0, 0, 0) is None, "the machine does not say how busy that CPU is"


@pytest.mark.parametrize(
    ("cpus", "vcpus", "took", "kept"),
    [
        (1, 1.0, 0.3, 0.3),
        (2, 2.0, 0.1, 0.05),
        (16, 2.0, 14.0, 0.0),  # a quota of two: two CPUs were left
        (16, 2.0, 15.0, 0.5),
        (16, 2.0, 40.0, 1.0),
        (2, 2.0, -0.1, 0.0),  # ticks are rounded
        (2, 2.0, None, None),
    ],
)
def test_the_fraction_that_others_kept_from_a_sample(
    monkeypatch: pytest.MonkeyPatch, cpus: int, vcpus: float, took: float | None, kept: float | None
) -> None:
    seconds = iter([10.0, 20.0])
    ends = iter([5.0, None if took is None else 5.0 + 10 * took])
    monkeypatch.setattr(resources, "read", lambda now_s, _but: reading(now_s, 0.0, outside_s=next(ends)))
    monkeypatch.setattr(resources, "usable_vcpus", lambda: vcpus)
    monkeypatch.setattr(resources.os, "sched_getaffinity", lambda _pid: set(range(cpus)))
    monkeypatch.setattr(resources.time, "monotonic", lambda: next(seconds))
    found = resources.Resources(resources.GpuReader([]))
    found.begin()
    facts = found.end()
    assert facts is not None
    assert facts.get("outside") == kept


def test_a_window_too_short_for_the_kernels_clock_has_no_facts(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter([10.0, 10.3])
    monkeypatch.setattr(resources, "read", lambda now_s, _but: reading(now_s, 0.0))
    monkeypatch.setattr(resources.time, "monotonic", lambda: next(seconds))
    found = resources.Resources(resources.GpuReader([]))
    found.begin()
    assert found.end() is None


def cgroups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: str, files: dict[str, str]) -> None:
    proc, root = tmp_path / "proc", tmp_path / "cgroup"
    (proc / "self").mkdir(parents=True)
    (proc / "self" / "cgroup").write_text(lines)
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.setattr(resources, "PROC", proc)
    monkeypatch.setattr(resources, "CGROUPS", root)
    monkeypatch.setattr(resources.os, "sched_getaffinity", lambda _pid: set(range(8)))


def test_version_two_of_cgroups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cgroups(tmp_path, monkeypatch, "0::/kube/pod/one\n", {
        "cpu.stat": "usage_usec 5\n", "kube/cpu.stat": "usage_usec 5\n", "kube/cpu.max": "max 100000\n",
        "kube/pod/cpu.max": "250000 100000\n", "kube/pod/cpu.stat": "usage_usec 5\nnr_periods 40\nnr_throttled 10\n",
        "kube/pod/one/cpu.max": "max 100000\n",
    })  # fmt: skip
    assert resources.usable_vcpus() == 2.5
    assert [*dict(resources._periods()).values()] == [(40, 10)]


def test_version_one_of_cgroups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cgroups(tmp_path, monkeypatch, V1, {
        "cpu/cpu.stat": "nr_periods 0\nnr_throttled 0\n", "cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n",
        "cpu/pod/one/cpu.stat": "nr_periods 7\nnr_throttled 3\nthrottled_time 9\n",
        "cpu/pod/one/cpu.cfs_quota_us": "150000\n", "cpu/pod/one/cpu.cfs_period_us": "100000\n",
    })  # fmt: skip
    assert resources.usable_vcpus() == 1.5
    assert sorted(dict(resources._periods()).values()) == [(0, 0), (7, 3)]


def test_a_machine_without_cgroups_or_network_has_its_affinity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cgroups(tmp_path, monkeypatch, "", {})
    assert resources.usable_vcpus() == 8
    assert dict(resources._periods()) == {}
    assert (resources._network(), resources._swapped()) == ((None, None), None)


def test_network_is_counted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = "{}: {} 1 0 0 0 0 0 0 {} 1 0 0 0 0 0 0\n"
    rows = "".join(row.format(*one) for one in (("lo", 5, 5), ("eth0", 100, 20), ("docker0", 90, 10)))
    (tmp_path / "net").mkdir()
    (tmp_path / "net" / "dev").write_text(f"Inter-|\n face |\n{rows}")
    monkeypatch.setattr(resources, "PROC", tmp_path)
    monkeypatch.setattr(resources, "INTERFACES", tmp_path / "devices")
    assert resources._network() == (190, 30), "in a container no device is the machine's"
    (tmp_path / "devices" / "eth0" / "device").mkdir(parents=True)
    assert resources._network() == (100, 20)


BURNS = """
import sys, time
kept = bytearray(64 * 2**20); kept[::4096] = b"x" * len(kept[::4096])
while time.process_time() < 0.5: pass
print("done", flush=True)
if sys.argv[1] == "stay": time.sleep(600)
"""


@pytest.mark.parametrize("then", ["stay", "end"])
def test_what_a_process_used_counts_while_it_lives_and_when_it_has_ended(then: str) -> None:
    """In a process of its own, which adopts: pytest's other children are not the sample's."""
    code = f"""
import subprocess, sys
from fogspec.agent import processes, resources
processes.adopt_orphans()
before = resources.read(0.0)
child = subprocess.Popen([sys.executable, "-c", {BURNS!r}, {then!r}], stdout=subprocess.PIPE)
child.stdout.readline()
if {then!r} == "end": child.wait()
after = resources.read(1.0)
none = resources.read(1.0, [child.pid])
child.kill(); child.wait()
print(after.cpu_s - before.cpu_s >= 0.45, after.minor_faults - before.minor_faults > 10_000,
      after.resident_bytes >= 2**26, none.resident_bytes)
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(resources.__file__).parents[2])}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, env=environment)
    assert ended.stdout.split() == ["True", "True", str(then == "stay"), "0"], ended.stderr


def test_this_computer_can_be_read() -> None:
    found = resources.read(1.0)
    assert found.at_s == 1.0
    assert resources.usable_vcpus() > 0
    assert processes.tree() is not None
