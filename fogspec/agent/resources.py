"""What a sample's processes use while requests are measured (Linux): CPU, memory, page faults, swap, network, GPUs.

Read once per second from /proc, from the counters of this process's cgroups (v1 or v2), and from nvidia-smi where there is one.
CPU time and page faults are those of all processes below this one, also of those that have ended: the kernel adds them to
the process that reaps them. What others took is what the CPUs worked besides that and for this process. Memory is the sum of
the resident memory of the living ones. Swap, network and GPUs are the machine's.
A figure that cannot be read is absent; no sample fails for it, and no look waits for anything.
"""

import contextlib
import os
import pty
import re
import subprocess
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import processes
from .machine_facts import read_text

PROC, CGROUPS, INTERFACES = Path("/proc"), Path("/sys/fs/cgroup"), Path("/sys/class/net")
EVERY_S = 1.0
LEAST_S = 0.5  # a shorter window shows nothing: the kernel counts CPU time in hundredths of a second
GIB = 2.0**30
READ_BYTES = 2**16
# Never by PATH, which is the workload's: Linux, GKE's node images, WSL, the driver container of the GPU operator.
NVIDIA_SMI = (
    "/usr/bin/nvidia-smi",
    "/usr/local/bin/nvidia-smi",
    "/usr/local/nvidia/bin/nvidia-smi",
    "/opt/nvidia/bin/nvidia-smi",
    "/usr/lib/wsl/lib/nvidia-smi",
    "/run/nvidia/driver/usr/bin/nvidia-smi",
)
GPU_QUERY = ("--query-gpu=index,utilization.gpu,memory.used,memory.total", "--format=csv,noheader,nounits")
MIB_PER_GIB = 1024


@dataclass(frozen=True)
class Reading:
    """The counters at one moment: CPU seconds, page faults, resident bytes of the processes; bytes of the machine."""

    at_s: float
    cpu_s: float
    minor_faults: int
    major_faults: int
    resident_bytes: int
    swapped_bytes: int | None
    received_bytes: int | None
    sent_bytes: int | None
    periods: dict[str, tuple[int, int]]  # of each cgroup's CPU quota: all, and those that were throttled
    outside_s: float | None = None  # CPU time of others, and of the host, on the CPUs that this process may use


@dataclass(frozen=True)
class GpuRow:
    """One GPU as nvidia-smi sees it: the share of time in which it computed, and its memory in MiB; None where it is N/A."""

    index: int
    busy: float | None
    used_mib: float | None
    total_mib: float | None


def gpu_rows(text: str) -> list[GpuRow]:
    """Return the GPUs in nvidia-smi's CSV (`GPU_QUERY`: without units); other lines, such as its errors, are skipped."""
    found = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) != 4 or not cells[0].isdigit():
            continue
        percent, used, total = (_number(cell) for cell in cells[1:])
        busy = None if percent is None else min(1.0, percent / 100)
        found.append(GpuRow(int(cells[0]), busy, used, total))
    return found


class GpuReader:
    """nvidia-smi, running in a loop beside the sample; without one, nothing."""

    def __init__(self, paths: Iterable[str] = NVIDIA_SMI, every_s: float = EVERY_S) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.terminal, self.rest = -1, b""
        path = next((one for one in paths if os.access(one, os.X_OK)), None)
        if path is None:
            return
        theirs = -1
        with contextlib.suppress(OSError):
            # On a terminal each line is written at once.
            self.terminal, theirs = pty.openpty()
            os.set_blocking(self.terminal, False)
            self.process = subprocess.Popen(
                [path, *GPU_QUERY, f"--loop-ms={every_s * 1000:.0f}"],
                stdin=subprocess.DEVNULL,
                stdout=theirs,
                stderr=subprocess.DEVNULL,
                env={"PATH": "/usr/bin:/bin", "LC_ALL": "C"},
                start_new_session=True,
            )
        if theirs >= 0:
            os.close(theirs)

    def read(self) -> list[GpuRow]:
        """Return what it has reported since the last call."""
        with contextlib.suppress(OSError):
            while self.terminal >= 0 and (piece := os.read(self.terminal, READ_BYTES)):
                self.rest += piece
        whole, _, self.rest = self.rest.rpartition(b"\n")
        self.rest = self.rest[-READ_BYTES:]
        return gpu_rows(whole.decode("ascii", "replace"))

    def pids(self) -> set[int]:
        """Return its process, which is not the sample's."""
        return set() if self.process is None else {self.process.pid}

    def close(self) -> None:
        """End it."""
        if self.process is not None:
            with contextlib.suppress(OSError):
                self.process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(1.0)
        if self.terminal >= 0:
            os.close(self.terminal)
            self.terminal = -1


class Resources:
    """The use of resources in one window: from `begin` to `end`, looked at once per `EVERY_S`."""

    def __init__(self, gpus: GpuReader | None = None) -> None:
        self.gpus = gpus or GpuReader()
        self.readings: list[Reading] = []
        self.before_bytes = _used()
        self.first: Reading | None = None
        self.last: Reading | None = None
        self.cpu_max = 0.0
        self.peak_bytes = 0
        self.own_s = 0.0
        self.busy: dict[int, list[float]] = {}
        self.used_mib: dict[int, float] = {}
        self.total_mib: dict[int, float] = {}

    def begin(self) -> None:
        """Begin the window, once."""
        if self.first is None:
            self.gpus.read()  # what it reported before does not count
            self.vcpus = usable_vcpus()
            self._look(time.monotonic())

    def look(self) -> None:
        """Read the counters if the window has begun and it is time."""
        now_s = time.monotonic()
        if self.last is not None and now_s - self.last.at_s >= EVERY_S:
            self._look(now_s)

    def end(self) -> dict[str, Any] | None:
        """End the window and the reader of GPUs; return the facts, memory in GiB, or None without a window worth it."""
        if self.first is not None:
            self._look(time.monotonic())
        self.gpus.close()
        first, last = self.first, self.last
        if first is None or last is None or (window_s := last.at_s - first.at_s) < LEAST_S:
            return None
        mean = max(0.0, last.cpu_s - first.cpu_s) / window_s
        found: dict[str, Any] = {
            "window": round(window_s, 3),
            "vcpus": round(self.vcpus, 3),
            "cpu_mean": round(mean, 3),
            "cpu_max": round(max(mean, self.cpu_max), 3),
            "outside": self._outside(window_s),
            "throttled": _throttled(first.periods, last.periods),
            "memory_peak": _gib(self.peak_bytes),
            "memory_before": _gib(self.before_bytes),
            "minor_faults": max(0, last.minor_faults - first.minor_faults),
            "major_faults": max(0, last.major_faults - first.major_faults),
            "swapped": _gib(_passed(first.swapped_bytes, last.swapped_bytes)),
            "received": _gib(_passed(first.received_bytes, last.received_bytes)),
            "sent": _gib(_passed(first.sent_bytes, last.sent_bytes)),
            "overhead": round(self.own_s / window_s, 5),
            **self._gpu_facts(),
        }
        return {name: value for name, value in found.items() if value is not None}

    def _outside(self, window_s: float) -> float | None:
        """Return the fraction of its vCPUs that others kept from the sample, as its host did (steal); None if it is unknown.

        Others may use CPUs that a quota keeps from the sample: what they left of all CPUs is compared with the vCPUs.
        """
        before, after = (None if one is None else one.outside_s for one in (self.first, self.last))
        if before is None or after is None:
            return None
        left = len(os.sched_getaffinity(0)) - max(0.0, after - before) / window_s
        return round(min(1.0, max(0.0, 1 - left / self.vcpus)), 4)

    def _look(self, now_s: float) -> None:
        begun_s = time.thread_time()
        for row in self.gpus.read():
            self._take(row)
        reading = read(now_s, self.gpus.pids())
        if self.last is None:
            self.first = reading
        elif now_s - self.last.at_s >= LEAST_S:
            used = (reading.cpu_s - self.last.cpu_s) / (now_s - self.last.at_s)
            self.cpu_max = max(self.cpu_max, used)
        self.peak_bytes = max(self.peak_bytes, reading.resident_bytes)
        self.last = reading
        self.own_s += time.thread_time() - begun_s

    def _take(self, row: GpuRow) -> None:
        if row.busy is not None:
            self.busy.setdefault(row.index, []).append(row.busy)
        for kept, value in ((self.used_mib, row.used_mib), (self.total_mib, row.total_mib)):
            if value is not None:
                kept[row.index] = max(kept.get(row.index, 0.0), value)

    def _gpu_facts(self) -> dict[str, Any]:
        """Return the number of GPUs, and the use and memory of the one that is used most."""
        seen = self.busy.keys() | self.used_mib.keys()
        if not seen:
            return {}
        means = [sum(one) / len(one) for one in self.busy.values()]
        found: dict[str, Any] = {"gpus": len(seen)}
        if means:
            found["gpu_mean"] = round(max(means), 4)
            found["gpu_max"] = max(max(one) for one in self.busy.values())
        if self.used_mib:
            index, used = max(self.used_mib.items(), key=lambda one: one[1])
            found["gpu_memory_peak"] = round(used / MIB_PER_GIB, 4)
            if index in self.total_mib:
                found["gpu_memory"] = round(self.total_mib[index] / MIB_PER_GIB, 4)
        return found


def read(now_s: float, but: Iterable[int] = ()) -> Reading:
    """Return the counters now, of all processes below this one except `but`."""
    cpu_ticks, own_ticks, minor, major, pages = 0, 0, 0, 0, 0
    if own := _stat("self"):
        minor, major, cpu_ticks, own_ticks = own[8], own[10], own[13] + own[14], own[11] + own[12]
    for pid in processes.tree() - set(but):
        if found := _stat(pid):
            minor, major = minor + found[7] + found[8], major + found[9] + found[10]
            cpu_ticks += sum(found[11:15])
            pages += found[21]
    own_ticks += sum(sum(_stat(pid)[11:15]) for pid in but)
    busy, tick_s = busy_ticks(os.sched_getaffinity(0)), 1 / os.sysconf("SC_CLK_TCK")
    received, sent = _network()
    return Reading(
        now_s,
        cpu_ticks * tick_s,
        minor,
        major,
        pages * os.sysconf("SC_PAGE_SIZE"),
        _swapped(),
        received,
        sent,
        dict(_periods()),
        None if busy is None else (busy - cpu_ticks - own_ticks) * tick_s,
    )


def busy_ticks(cpus: set[int]) -> int | None:
    """Return for how long these CPUs worked or were stolen, in ticks; None if that cannot be read.

    Interrupts are left out: the sample's own network and disks cause them, too.
    """
    rows = re.findall(r"^cpu(\d+) (\d+) (\d+) (\d+)(?: \d+){4} (\d+)", read_text(PROC / "stat"), re.MULTILINE)
    found = [sum(map(int, ticks)) for number, *ticks in rows if int(number) in cpus]
    return sum(found) if len(found) == len(cpus) else None


def usable_vcpus() -> float:
    """Return how many vCPUs this process may use, by its affinity and its cgroups' quotas."""
    found = float(len(os.sched_getaffinity(0)))
    for folder in _cgroups("cpu"):
        if limit := re.match(r"(\d+) (\d+)$", read_text(folder / "cpu.max").strip()):
            quota, period = int(limit[1]), int(limit[2])
        else:
            quota, period = (
                int(text) if (text := read_text(folder / name).strip()).isdigit() else 0
                for name in ("cpu.cfs_quota_us", "cpu.cfs_period_us")
            )
        if quota and period:
            found = min(found, quota / period)
    return found


def _stat(pid: int | str) -> list[int]:
    """Return the fields of /proc/PID/stat after the name; nothing if the process is gone. The first, its state, is 0."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        with open(PROC / str(pid) / "stat", "rb") as file:
            found = [0, *map(int, file.read().rsplit(b")", 1)[1].split()[1:22])]
        return found if len(found) == 22 else []
    return []


def _used() -> int | None:
    """Return the bytes of this machine's memory that others use, as far as they cannot be taken from them; None if unknown."""
    found = dict(re.findall(r"^(MemTotal|MemAvailable):\s+(\d+) kB$", read_text(PROC / "meminfo"), re.MULTILINE))
    return max(0, int(found["MemTotal"]) - int(found["MemAvailable"])) * 1024 if len(found) == 2 else None


def _swapped() -> int | None:
    """Return the bytes that this machine has moved to and from swap since it was started."""
    pages = re.findall(r"^pswp(?:in|out) (\d+)$", read_text(PROC / "vmstat"), re.MULTILINE)
    return sum(map(int, pages)) * os.sysconf("SC_PAGE_SIZE") if len(pages) == 2 else None


def _network() -> tuple[int | None, int | None]:
    """Return the bytes that came and went through network devices; in a container, through all but the loopback."""
    counted: dict[str, tuple[int, int]] = {}
    for line in read_text(PROC / "net" / "dev").splitlines()[2:]:
        name, _, rest = line.partition(":")
        cells = rest.split()
        if len(cells) >= 9 and name.strip() != "lo":
            counted[name.strip()] = int(cells[0]), int(cells[8])
    # Bridges and tunnels would count again what passes the device below them.
    devices = [name for name in counted if os.path.exists(INTERFACES / name / "device")] or list(counted)
    if not devices:
        return None, None
    return sum(counted[one][0] for one in devices), sum(counted[one][1] for one in devices)


def _periods() -> Iterator[tuple[str, tuple[int, int]]]:
    for folder in _cgroups("cpu"):
        text = read_text(folder / "cpu.stat")
        found = [re.search(rf"^{name} (\d+)$", text, re.MULTILINE) for name in ("nr_periods", "nr_throttled")]
        if found[0] and found[1]:
            yield str(folder), (int(found[0][1]), int(found[1][1]))


def _cgroups(controller: str) -> list[Path]:
    """Return the folders of this process's cgroup and those above it, version 1 or 2."""
    for line in read_text(PROC / "self" / "cgroup").splitlines():
        _, names, path = line.split(":", 2)
        if names and controller not in names.split(","):
            continue
        for root in (CGROUPS / names, CGROUPS / controller) if names else (CGROUPS, CGROUPS / "unified"):
            if (root / "cpu.stat").exists():
                own = root / path.lstrip("/")
                # A container may see only the root of the path that the host has for it.
                return [one for one in (own, *own.parents) if one == root or root in one.parents]
    return []


def _throttled(before: dict[str, tuple[int, int]], after: dict[str, tuple[int, int]]) -> float | None:
    """Return the share of periods in which a quota stopped the processes, of the cgroup where it was largest."""
    found = []
    for name, (periods, throttled) in after.items():
        passed = periods - before.get(name, (0, 0))[0]
        if name in before and passed > 0:
            found.append(min(1.0, max(0.0, (throttled - before[name][1]) / passed)))
    return round(max(found), 4) if found else None


def _passed(before: int | None, after: int | None) -> int | None:
    return None if before is None or after is None else max(0, after - before)


def _gib(count: int | None) -> float | None:
    return None if count is None else float(f"{count / GIB:.4g}")


def _number(cell: str) -> float | None:
    return float(cell) if re.fullmatch(r"\d{1,9}(\.\d{1,6})?", cell) else None
