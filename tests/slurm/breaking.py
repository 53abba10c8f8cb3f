"""What can break on the cluster from outside: processes, nodes, the network."""

import contextlib
import os
import signal
import threading
import time
from pathlib import Path

from tests.tools.slurm import daemons, engine

CUT_S, NODE_DOWN_S = 10.0, 3.0
_one_at_a_time = threading.Lock()


def kill(pid: int, number: int = signal.SIGKILL) -> None:
    """A signal to a process that may be gone."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def kill_below(pid: int) -> int:
    """End the processes below this one, of which SkyPilot's worker is one; how many there were."""
    found = daemons.below(pid)
    for one in found:
        kill(one)
    return len(found)


def end_server(cluster: Path, alone_s: float = 0.0) -> bool:
    """End the API server, and so many seconds later its other processes; whether it ran.

    Somebody must end those too: one holds a port that a new server needs (SkyPilot 0.14.1).
    """
    servers, others = _server(cluster)
    for pid in servers:
        kill(pid)
    time.sleep(alone_s)
    for pid in others:
        kill(pid)
    return bool(servers)


def _server(cluster: Path) -> tuple[list[int], list[int]]:
    servers, others = list[int](), list[int]()
    for pid in engine.processes(cluster):
        with contextlib.suppress(OSError):
            command = Path("/proc", str(pid), "cmdline").read_bytes()
            if b"sky.server.server" in command:
                servers.append(pid)
            elif command.startswith(b"SkyPilot:") or b"from multiprocessing" in command:
                others.append(pid)
    return servers, others


def node_down(cluster: Path, node: str) -> None:
    """A node fails, with all that runs on it, and comes back."""
    daemons.run(cluster, "scontrol", "update", f"nodename={node}", "state=down", "reason=fault")
    time.sleep(NODE_DOWN_S)
    with contextlib.suppress(SystemExit):  # it may have come back by itself
        daemons.run(cluster, "scontrol", "update", f"nodename={node}", "state=resume")


def unplug(cluster: Path) -> None:
    """The login node cannot be reached for a while, and what was connected breaks off."""
    pid = daemons.living(cluster, "sshd")
    assert pid is not None
    with _one_at_a_time:
        os.kill(pid, signal.SIGSTOP)
        kill_below(pid)
        time.sleep(CUT_S)
        os.kill(pid, signal.SIGCONT)
