"""Processes that share the work of a command."""

import signal
import subprocess
import sys
from pathlib import Path

from tests.support.scenes import until

POOL = """
import os, time
from fogspec.base.workers import processes

def pid(_):
    return os.getpid()

if __name__ == "__main__":
    with processes(2) as pool:
        print(*set(pool.map(pid, range(40))), flush=True)
        time.sleep(600)
"""


def running(pid: int) -> bool:
    """Whether a process is there and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_they_end_with_a_command_that_was_killed(tmp_path: Path) -> None:
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    workers = [int(word) for word in parent.stdout.readline().split()]
    assert workers
    assert all(map(running, workers))
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until(lambda: not any(map(running, workers)))
