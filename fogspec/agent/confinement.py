"""Confine processes to a part of this machine: some of its vCPUs, and some of its memory (Linux).

The vCPUs are whole cores, both threads of each, of as few sockets as possible. A cgroup (version 2) of its own holds the
processes to them and to the memory where it can be made; otherwise they inherit an affinity, and memory is not limited.
"""

import contextlib
import os
import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

CGROUPS, CPUS = Path("/sys/fs/cgroup"), Path("/sys/devices/system/cpu")
# Enters the cgroup before it becomes the program, so that nothing of it runs outside.
ENTER = ["sh", "-c", 'echo $$ > "$0" && exec "$@"']


class Confinement:
    """A part of this machine, while it is entered: what this process starts by `command` is held to it.

    Raise OSError if this process may use fewer vCPUs, or if they cannot be set.
    """

    def __init__(self, cpus: int, memory_bytes: int, root: Path = CGROUPS) -> None:
        self.before = os.sched_getaffinity(0)
        self.cpus = together(self.before)[:cpus]
        if len(self.cpus) < cpus:
            raise OSError(f"{cpus} vCPUs were requested, and {len(self.before)} may be used")
        self.group, self.limits = _new_group(root, self.cpus, memory_bytes)

    def __enter__(self) -> "Confinement":
        os.sched_setaffinity(0, self.cpus)
        return self

    def __exit__(self, *_: object) -> None:
        os.sched_setaffinity(0, self.before)
        if self.group is not None:
            _remove(self.group)

    def command(self, argv: list[str]) -> list[str]:
        """Return the command that starts a program within the part."""
        return argv if self.group is None else [*ENTER, str(self.group / "cgroup.procs"), *argv]

    def kills(self) -> int:
        """Return how often the kernel killed a process of the part for lack of memory."""
        found = (
            re.search(r"^oom_kill (\d+)$", _text(self.group / "memory.events"), re.MULTILINE) if self.group else None
        )
        return int(found[1]) if found else 0

    def facts(self) -> dict[str, Any]:
        """Return by what the vCPUs and the memory are held to the part."""
        return {"cpus_by": "cpuset" if "cpuset" in self.limits else "affinity", "memory_by": self.limits.get("memory")}


def together(usable: Iterable[int], cpus: Path = CPUS) -> list[int]:
    """Return these vCPUs in an order in which the threads of a core, and the cores of a socket, stand together."""

    def place(cpu: int) -> tuple[int, int, int]:
        topology = cpus / f"cpu{cpu}" / "topology"
        siblings = re.match(r"\d+", _text(topology / "thread_siblings_list"))
        socket = _text(topology / "physical_package_id").strip()
        return int(socket) if socket.isdigit() else 0, int(siblings[0]) if siblings else cpu, cpu

    return sorted(usable, key=place)


def _new_group(root: Path, cpus: list[int], memory_bytes: int) -> tuple[Path | None, dict[str, str]]:
    """Return a new cgroup with these limits and the names of those that hold; None if none of them can be set.

    It is beside this process's own one: a cgroup with processes has no cgroups with limits below it, except for the root.
    """
    own = re.search(r"^0::/(.*)$", _text(Path("/proc/self/cgroup")), re.MULTILINE)
    if own is None:
        return None, {}
    here = root / own[1]
    for above in [here, *here.parents[:1]] if own[1] else [here]:
        if not os.access(above / "cgroup.procs", os.W_OK):
            continue
        group, limits = above / f"fogspec-part-{os.getpid()}-{time.monotonic_ns()}", dict[str, str]()
        with contextlib.suppress(OSError):
            group.mkdir()
            for name, by, value in (
                ("cpuset.cpus", "cpuset", ",".join(map(str, cpus))),
                ("memory.max", "cgroup", str(memory_bytes)),
            ):
                # Opened without creating it: if it is missing, there is no such controller.
                with contextlib.suppress(OSError), open(group / name, "r+") as file:
                    file.write(value)
                    file.flush()
                    limits["cpuset" if by == "cpuset" else "memory"] = by
            if limits:
                with contextlib.suppress(OSError), open(group / "memory.swap.max", "r+") as file:
                    file.write("0")
                return group, limits
            group.rmdir()
    return None, {}


def _remove(group: Path) -> None:
    with contextlib.suppress(OSError), open(group / "cgroup.kill", "r+") as file:
        file.write("1")
    for _ in range(50):
        with contextlib.suppress(OSError):
            group.rmdir()
        if not group.is_dir():
            return
        time.sleep(0.02)


def _text(path: Path) -> str:
    with contextlib.suppress(OSError), open(path) as file:
        return file.read(65536)
    return ""
