"""What this host lets a process use: CPUs and memory, within the limits of containers and slices (Linux)."""

import math
import os
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")


def capacity() -> tuple[int, float]:
    """Return the most CPUs and GiB that a job can have on this host, within limits of containers and slices."""
    cpus = float(len(os.sched_getaffinity(0)))
    memory_bytes: float = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for folder in limiting(""):
        cpus = min(cpus, _share(*text(folder / "cpu.max").partition(" ")[::2]))
        memory_bytes = min(memory_bytes, _bytes(folder / "memory.max"))
    for folder in limiting("cpu"):
        cpus = min(cpus, _share(text(folder / "cpu.cfs_quota_us"), text(folder / "cpu.cfs_period_us")))
    for folder in limiting("memory"):
        memory_bytes = min(memory_bytes, _bytes(folder / "memory.limit_in_bytes"))
    return max(1, math.floor(cpus)), memory_bytes / 2**30


def limiting(controller: str) -> list[Path]:
    """Return the cgroups whose limits hold for this process: its own and all above, up to the visible root.

    They are of a version 1 controller, or with "" of version 2.
    """
    root, own = CGROUPS / controller if controller else version_2(), _own(controller)
    return [] if own is None else [root / own, *(root / own).parents[: len(Path(own).parts)]]


def version_2() -> Path:
    """Return where version 2 of cgroups is mounted: on hybrid hosts beside the controllers of version 1."""
    hybrid = CGROUPS / "unified"
    return hybrid if (hybrid / "cgroup.procs").is_file() else CGROUPS


def text(path: Path) -> str:
    """Return the text of a file of the kernel's; nothing for one that cannot be read."""
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""


def _own(controller: str) -> str | None:
    """Return this process's cgroup of a version 1 controller, or with "" that of version 2; None if there is none."""
    rows = (line.split(":", 2) for line in text(Path("/proc/self/cgroup")).splitlines())
    return next((path.strip("/") for _, names, path in rows if controller in names.split(",")), None)


def _share(quota: str, period: str) -> float:
    return int(quota) / int(period) if quota.isdigit() and period.isdigit() else math.inf


def _bytes(path: Path) -> float:
    limit = text(path)
    return int(limit) if limit.isdigit() else math.inf
