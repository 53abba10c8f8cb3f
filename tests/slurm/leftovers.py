"""What is left of one application on the cluster and on disk: looked up here, not asked of fogspec."""

import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from tests.slurm.site import Site
from tests.tools.slurm import engine, login

MARK = "FOGSPEC_TEST_LIFE"
PATIENCE_S = 300.0
KINDS = ("jobs", "clusters", "processes", "commands", "files", "keys")
# SkyPilot makes them and forgets them where Slurm itself has ended the job: nobody else can know whose they are.
SKYPILOTS = "SkyPilot's folders on the cluster"


def now(site: Site, name: str) -> dict[str, list[str]]:
    """Slurm's jobs, processes of the jobs' user, fogspec's own and its workers, keys of links and folders on the nodes."""
    prefix = f"fogspec-{name}-"
    return {
        "jobs": [job for job in site.jobs() if job.startswith(prefix)],
        "processes": [line for line in login.processes() if prefix.encode() in _about(line.split()[0])],
        "commands": [pid for pid in filter(str.isdigit, os.listdir("/proc")) if _is_command(pid, name)],
        "keys": [str(key) for path in folders(site.cluster, name) for key in path.glob(".fogspec/links/*/*/private*")],
        SKYPILOTS: [str(path) for path in folders(site.cluster, name)],
    }


def files(root: Path, expected: set[str]) -> list[str]:
    """Files and folders below `root` that were not there before: live state, locks, half-written files."""
    return sorted(tree(root) - expected)


def tree(root: Path) -> set[str]:
    """Every path below a folder, relative to it."""
    return {path.relative_to(root).as_posix() for path in root.rglob("*") if "__pycache__" not in path.parts}


def folders(cluster: Path, name: str) -> Iterator[Path]:
    """Homes of the application's jobs on the nodes, which SkyPilot makes and is to remove."""
    for parent in (cluster / "home" / ".sky_clusters", cluster / "tmp"):
        yield from parent.glob(f"fogspec-{name}-*")


def clusters(site: Site, name: str, attempts: int = 3) -> list[str]:
    """Clusters that SkyPilot has a record of; asked again where others end its API server meanwhile."""
    for left in reversed(range(attempts)):
        try:
            return [one for one in engine.clusters(site.cluster) if one.startswith(f"fogspec-{name}-")]
        except (IndexError, ValueError):
            if not left:
                raise
            time.sleep(5)
    raise AssertionError


def settled(site: Site, name: str) -> dict[str, list[str]]:
    """What is there when everything has had time to end."""
    end = time.monotonic() + PATIENCE_S
    while _any(found := now(site, name)) and time.monotonic() < end:
        time.sleep(0.5)
    return found


def _any(found: Mapping[str, list[str]]) -> bool:
    return any(those for kind, those in found.items() if kind in KINDS)


def _about(pid: str) -> bytes:
    try:
        return Path("/proc", pid, "environ").read_bytes() + Path("/proc", pid, "cmdline").read_bytes()
    except OSError:
        return b""


def _is_command(pid: str, name: str) -> bool:
    """Whether it is fogspec's command line or its worker: the API server that it may have started is the user's."""
    about = _about(pid)
    return f"{MARK}={name}\0".encode() in about and b"\0-m\0fogspec" in about
