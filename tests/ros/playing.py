"""Starts what a generated launch file says, in its order, as `ros2 launch` does; `launch` itself is not on PyPI.

python -m tests.ros.playing LAUNCH_FILE
"""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.support.launching import launched


def main(path: Path) -> int:
    """Start everything, wait for the last process, end the others; its exit code."""
    running = []
    for one in launched(path):
        if one.kind == "SetEnvironmentVariable":
            os.environ[one.arguments[0]] = one.arguments[1]
        elif one.kind == "OpaqueFunction":
            one.keywords["function"](None)
        elif one.kind == "ExecuteProcess":
            more = one.keywords.get("additional_env", {})
            running.append(
                subprocess.Popen(one.keywords["cmd"], cwd=one.keywords.get("cwd"), env={**os.environ, **more})
            )
        elif one.kind == "Node":
            running.append(subprocess.Popen(node_command(one.keywords)))
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    left = running
    try:
        code, left = running[-1].wait(), running[:-1]
    except KeyboardInterrupt:
        code = 130
    for process in left:
        end(process)
    return code


def node_command(keywords: dict[str, Any]) -> list[str]:
    """The program of a node without parameters; others are not played here."""
    more = keywords.keys() - {"package", "executable", "output", "on_exit"}
    if more:
        raise ValueError(f"this player gives nodes no {', '.join(sorted(more))}")
    return ["ros2", "run", keywords["package"], keywords["executable"]]


def end(process: "subprocess.Popen[bytes]") -> None:
    """INT, TERM and KILL, five seconds apart, as launch does."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        process.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5)
            return
    raise TimeoutError(f"{process.args} does not end")


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
