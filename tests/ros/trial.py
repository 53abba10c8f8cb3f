"""One node with a known busy time, watched by every probe at once."""

import contextlib
import json
import os
import statistics
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.ros.namespaces import PYTHON, Net
from tests.support.agent import AGENT

NODES = Path(__file__).parent / "nodes"
ASKED = {
    "service": ("--service", "/plan"),
    "action": ("--action", "/navigate"),
    "topic": ("--request", "/imu", "--response", "/pose"),
}
MATCHES = ("stamp", "order", "first_request", "last_response")


@dataclass(frozen=True)
class Trial:
    """What each probe wrote, what is true, and what each listener cost in seconds of CPU from the first request on."""

    records: dict[str, list[dict[str, Any]]]
    truth_s: list[float]
    cpu_s: dict[str, float]
    client: str

    def good(self, probe: str) -> list[dict[str, Any]]:
        """The requests that succeeded."""
        return [one for one in self.records[probe] if one.get("ok")]

    def median_s(self, probe: str, what: str) -> float:
        """The median of `latency_s` or `service_s`."""
        return statistics.median(one[what] for one in self.good(probe))

    def warnings(self, probe: str) -> list[str]:
        """What the probe said of its own figures."""
        return [one["warning"] for one in self.records[probe] if "warning" in one]


def run(
    net: Net, kind: str, busy_s: float, count: int, rate: float | None = None, *more: str, program: Path | None = None
) -> Trial:
    """`count` requests, closed-loop or at a rate; `more` are words for the node, `program` takes the place of busy.py."""
    listeners = {"service": (), "action": ("rclpy",), "topic": MATCHES}[kind]
    started = {}
    for name in listeners:
        words = [*ASKED[kind], *(["--match", name] if kind == "topic" else [])]
        started[name] = net.python(name, "-m", "fogspec_agent.topics", *words, PYTHONPATH=str(AGENT),
                                   FOGSPEC_TIMINGS=str(net.folder / f"{name}.jsonl"))  # fmt: skip
    node = [
        *([str(program)] if program else [str(PYTHON), str(NODES / "busy.py")]),
        kind,
        str(busy_s),
        str(net.folder / "truth"),
        *more,
    ]
    node += ["--watchers", str(len(listeners))] if kind == "topic" else []
    server = net.python("server", "-m", "fogspec_agent.preload", *ASKED[kind], "--", *node, PYTHONPATH=str(AGENT),
                        FOGSPEC_TIMINGS=str(net.folder / "preload.jsonl"))  # fmt: skip
    pace = [] if rate is None else ["--rate", str(rate)]
    words = [
        str(PYTHON),
        str(NODES / "client.py"),
        kind,
        str(count),
        "--watchers",
        str(len(listeners)),
        "--limit",
        "8",
        *pace,
    ]
    client = net.start("client", words)
    cpu_s = {name: -cpu_of(process.popen.pid) for name, process in started.items()}
    while not (net.folder / "preload.jsonl").exists() and client.popen.poll() is None:
        cpu_s = {name: -cpu_of(process.popen.pid) for name, process in started.items()}
        time.sleep(0.05)
    client.popen.wait(600)
    cpu_s = {name: cpu_s[name] + cpu_of(process.popen.pid) for name, process in started.items()}
    for process in [*started.values(), server]:
        process.stop()
    return Trial(
        {name: records(net.folder / f"{name}.jsonl") for name in ("preload", *listeners)},
        [one["busy_s"] for one in records(net.folder / "truth")], cpu_s, client.said(),
    )  # fmt: skip


def compiled(folder: Path) -> Path:
    """busy.c, which is a node without rclpy, compiled against the rcl of the wheels."""
    ros = PYTHON.parents[1]
    program = folder / "busy"
    libraries = ["rcl", "rcutils", "std_srvs__rosidl_typesupport_c", "std_srvs__rosidl_generator_c"]
    words = [
        *(f"-I{one}" for one in sorted((ros / "include").iterdir())), str(NODES / "busy.c"), "-o", str(program),
        f"-L{ros / 'lib'}", "-Wl,--allow-shlib-undefined", *(f"-l{name}" for name in libraries),
    ]  # fmt: skip
    subprocess.run(["cc", "-O2", "-rdynamic", "-Wall", "-Wextra", "-Werror", *words], check=True, timeout=600)
    return program


def records(path: Path) -> list[dict[str, Any]]:
    """The lines of a file."""
    with contextlib.suppress(FileNotFoundError):
        return [json.loads(line) for line in path.read_text().splitlines()]
    return []


def cpu_of(pid: int) -> float:
    """Seconds of CPU that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
