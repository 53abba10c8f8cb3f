"""Deployments that a watch keeps serving: how long each fault takes them away, and whether a machine is ever there twice.

    python -m tests.faults.watching [RUNS]

lets a watch of the real command line look after a deployment on this host, puts RUNS faults into it (30), one after the other,
and prints the time from each fault until another node answers, and how many machines were there twice once it did.
"""

import contextlib
import itertools
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

from tests.faults import deployments
from tests.support.deployed import MANIFEST, SPEC, Deployed

PATIENCE_S = 1200.0
INTERVAL = "1s"
RESPAWN = SPEC.replace("[python3, work.py]", "[python3, work.py]\n      launch: {respawn: on_failure}")


def nodes(deployed: Deployed) -> list[int]:
    """Return the living processes of the node itself."""
    found = []
    for pid in deployed.alive():
        with contextlib.suppress(OSError):
            if b"python3\0work.py\0" in Path("/proc", str(pid), "cmdline").read_bytes():
                found.append(pid)
    return found


def answers(deployed: Deployed) -> bool:
    """Return whether the node of the one machine that serves has answered a request since its machine was started."""
    serving = [one["name"] for one in deployed.machines() if one["state"] == "serving"]
    out = [deployed.state / "deployed" / name / "out" / "timings.jsonl" for name in serving]
    return len(nodes(deployed)) == 1 and len(out) == 1 and out[0].exists() and out[0].stat().st_size > 0


class Watching:
    """A watch in a process of its own, started again when it ends, as systemd does."""

    def __init__(self, deployed: Deployed) -> None:
        self.deployed = deployed
        self.process = self._started()

    def _started(self) -> "subprocess.Popen[bytes]":
        quiet = subprocess.DEVNULL
        words = self.deployed.command("watch", "--yes", "--interval", INTERVAL, "--max-restarts", "60")
        return subprocess.Popen(words, cwd=self.deployed.folder, stdin=quiet, stdout=quiet, stderr=quiet)

    def keep(self) -> None:
        """Start it again if it has ended."""
        if self.process.poll() is not None:
            self.process = self._started()

    def kill(self, number: int = signal.SIGKILL) -> None:
        """End it."""
        self.process.send_signal(number)
        self.process.wait()


def faults(deployed: Deployed, watching: Watching) -> list[tuple[str, Callable[[], object]]]:
    """Return the faults by their names."""

    def kill_node() -> None:
        for pid in nodes(deployed):
            os.kill(pid, signal.SIGKILL)

    def kill_watch_in_restart() -> None:
        before = deployed.names()
        deployed.kill()
        end_s = time.monotonic() + PATIENCE_S
        while deployed.names() == before and time.monotonic() < end_s:
            time.sleep(0.01)  # until it has recorded the machine that it starts
        watching.kill()

    def unreadable_state() -> None:
        live = deployed.state / "deployment.yaml"
        kept = live.read_bytes()
        live.write_bytes(b"machines: [")
        deployed.kill()
        time.sleep(3)
        assert not nodes(deployed), "nothing is started from a state that cannot be read"
        live.write_bytes(kept)

    return [
        ("kill -9 of the node", kill_node),
        ("kill -9 of the supervisor", lambda: deployments.orphaned(deployed)),
        ("the machine is lost", deployed.kill),
        ("kill -9 of the watch in a restart", kill_watch_in_restart),
        ("the state is unreadable for 3 s", unreadable_state),
    ]


def serve_again(deployed: Deployed, watching: Watching, before: list[int]) -> float | None:
    """Return the seconds until a node that is none of `before` answers alone; None if none does in time."""
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < PATIENCE_S:
        watching.keep()
        now = nodes(deployed)
        if not set(now) & set(before) and len(now) == 1 and answers(deployed) and len(deployed.machines()) == 1:
            return time.monotonic() - begun_s
        time.sleep(0.05)
    return None


def main(runs: int) -> int:
    """Print the figures; return 1 if something stayed away, was there twice or was left."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it in what it starts in the background
    waits, bad, twice = defaultdict[str, list[float]](list), 0, 0
    for spec, names in ((RESPAWN, ("kill -9 of the node",)), (SPEC, None)):
        with tempfile.TemporaryDirectory(prefix="fogspec-watching-") as scratch:
            deployed = Deployed.made(Path(scratch) / "app", spec)
            deployed("apply", MANIFEST, "--yes")
            watching = Watching(deployed)
            kinds = [one for one in faults(deployed, watching) if names is None or one[0] in names]
            for name, fault in itertools.islice(itertools.cycle(kinds), runs if names is None else max(1, runs // 5)):
                (deployed.state / "events.jsonl").unlink(missing_ok=True)
                watching.kill(signal.SIGINT)  # its count of restarts goes with it
                watching.keep()
                before = nodes(deployed)
                fault()
                took_s = serve_again(deployed, watching, before)
                twice += len(nodes(deployed)) > 1 or len(deployed.machines()) > 1
                bad += took_s is None
                if took_s is not None:
                    waits[f"{name}{', with respawn' if names else ''}"].append(took_s)
            watching.kill(signal.SIGINT)
            deployed("down", "tiny")
            (deployed.state / "events.jsonl").unlink(missing_ok=True)
            bad += not deployments.left(deployed).nothing
    for name, all_s in waits.items():
        print(
            f"{name}: serves again after {statistics.median(all_s):.1f} s (max {max(all_s):.1f}, {len(all_s)} faults)"
        )
    count = sum(map(len, waits.values()))
    print(f"{count} faults, a watch every {INTERVAL}: {twice} machines twice, {bad} stayed away or left anything")
    return 1 if bad or twice else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 30))
