"""The server that a sample runs on: its CPU, and how busy others kept it.

One instance type is not one machine: clouds rent the same type on servers with different CPUs, and neighbours take time.
`/proc` and `/sys` are read once at the start and once at the end. Facts that cannot be read are absent; no sample fails for it.
"""

import contextlib
import os
import platform
import re
from pathlib import Path
from typing import Any

PROC, CPUS = Path("/proc"), Path("/sys/devices/system/cpu")
# Instruction sets that make numerical code faster: x86 and Arm.
FEATURES = frozenset(
    {"sse4_2", "avx", "avx2", "fma", "avx512f", "avx512bw", "avx512_vnni", "avx512_bf16", "amx_tile"}
    | {"asimd", "asimddp", "sve", "sve2", "i8mm", "bf16"}
)
ARM_PARTS = {"0xd0c": "Neoverse-N1", "0xd40": "Neoverse-V1", "0xd49": "Neoverse-N2", "0xd4f": "Neoverse-V2"}
READ_BYTES = 2**21


def read(proc: Path = PROC, cpus: Path = CPUS) -> dict[str, Any]:
    """Return the facts of this machine now, with counters of its CPU time since it was started, in ticks."""
    info, stat = read_text(proc / "cpuinfo"), read_text(proc / "stat")
    found: dict[str, Any] = {
        "cpu": _cpu(info),
        "arch": platform.machine(),
        "kernel": read_text(proc / "sys" / "kernel" / "osrelease").strip() or None,
        "driver": _driver(read_text(proc / "driver" / "nvidia" / "version")),
        "features": _features(info),
        **_topology(cpus),
        "clock_ghz": _clock_ghz(info, cpus),
    }
    if times := re.search(r"^cpu +(.*)$", stat, re.MULTILINE):
        ticks = [int(one) for one in times[1].split()[:8] if one.isdigit()]
        found["ticks"], found["stolen"] = sum(ticks), ticks[7] if len(ticks) == 8 else 0
        found["waited"] = ticks[4] if len(ticks) > 4 else 0
    if running := re.search(r"^procs_running (\d+)$", stat, re.MULTILINE):
        # Without this process, which runs to read it.
        found["run_queue"] = max(0, int(running[1]) - 1)
    return {name: value for name, value in found.items() if value is not None}


def between(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return the facts of the machine over a sample: those of its end, the fractions of CPU time stolen and spent
    waiting for disks, and another CPU.
    """
    found = {name: value for name, value in after.items() if name not in ("ticks", "stolen", "waited")}
    passed = after.get("ticks", 0) - before.get("ticks", 0)
    if passed > 0:
        for name, counter in (("steal", "stolen"), ("io_wait", "waited")):
            found[name] = round(min(1.0, max(0.0, (after[counter] - before.get(counter, 0)) / passed)), 4)
    if before.get("cpu") != after.get("cpu"):
        found["cpu"], found["changed_to"] = before.get("cpu"), after.get("cpu")
    return {name: value for name, value in found.items() if value is not None}


def _cpu(info: str) -> str | None:
    """Return the CPU's model; on Arm its implementer and part, for which Linux has no name."""
    if model := re.search(r"^model name\s*:\s*(\S.*)$", info, re.MULTILINE):
        return " ".join(model[1].split())
    implementer, part = (re.search(rf"^CPU {name}\s*:\s*(\S+)", info, re.MULTILINE) for name in ("implementer", "part"))
    if implementer is None or part is None:
        return None
    return ARM_PARTS.get(part[1], f"Arm {implementer[1]} {part[1]}")


def _driver(version: str) -> str | None:
    """Return the version of NVIDIA's kernel module."""
    found = re.search(r"Kernel Module.*?\s(\d+(?:\.\d+)+)\s", version)
    return found[1] if found else None


def _features(info: str) -> list[str] | None:
    flags = re.search(r"^(?:flags|Features)\s*:\s*(.*)$", info, re.MULTILINE)
    return sorted(FEATURES.intersection(flags[1].split())) if flags else None


def _topology(cpus: Path) -> dict[str, int]:
    """Return the numbers of sockets, cores and threads; nothing if they are unknown."""
    threads = [one for one in _listed(cpus) if re.fullmatch(r"cpu\d+", one.name)]
    places = []
    for thread in threads:
        socket, core = (read_text(thread / "topology" / name).strip() for name in ("physical_package_id", "core_id"))
        if socket and core:
            places.append((socket, core))
    if not places:
        return {}
    return {"sockets": len({socket for socket, _ in places}), "cores": len(set(places)), "threads": len(places)}


def _clock_ghz(info: str, cpus: Path) -> float | None:
    """Return the mean clock of the CPUs now."""
    mhz = [float(one) for one in re.findall(r"^cpu MHz\s*:\s*([0-9.]+)$", info, re.MULTILINE)]
    if not mhz:
        texts = (read_text(one / "cpufreq" / "scaling_cur_freq").strip() for one in _listed(cpus))
        mhz = [int(one) / 1000 for one in texts if one.isdigit()]
    return round(sum(mhz) / len(mhz) / 1000, 3) if mhz else None


def _listed(folder: Path) -> list[Path]:
    with contextlib.suppress(OSError):
        return sorted(folder.iterdir())
    return []


def read_text(path: Path, most: int = READ_BYTES) -> str:
    """Return a file of the system's, about `most` bytes of it; an empty text if it cannot be read."""
    with contextlib.suppress(OSError), open(path, "rb", buffering=0) as file:
        content = b""
        while len(content) < most and (part := os.read(file.fileno(), READ_BYTES)):
            content += part
        return content.decode("utf-8", "replace")
    return ""
