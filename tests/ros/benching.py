"""`fogspec compile` and `fogspec bench --runner local` of a spec with real ROS 2 nodes, inside a network of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from tests.ros.namespaces import PYTHON, Net
from tests.support.forking import Ended, forked
from tests.support.results import document

NODES = Path(__file__).parent / "nodes"
FOGSPEC = Path(sys.executable).with_name("fogspec")


def node(name: str, *words: Any) -> dict[str, list[str]]:
    """A process of the spec: one of the nodes in this folder, run by the Python that has ROS 2."""
    return {"cmd": [str(PYTHON), str(NODES / f"{name}.py"), *map(str, words)]}


def write_spec(net: Net, spec: dict[str, Any]) -> Path:
    """A spec of one sample on one CPU of this machine; `spec` is merged into it."""
    benchmark = {
        "machines": ["local/1cpu-1gib"], "warmup": 2, "ready_timeout": "10min",
        "stop": {"requests": 25, "duration": "60s"},
    } | spec.pop("benchmark", {})  # fmt: skip
    whole = {
        "apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "robot"},
        "spec": {"infra": ["aws/us-east-1"], "hardware": {"cpus": "1..2"}, "benchmark": benchmark,
                 "ros": {"image": "docker.io/library/ros:jazzy"}, **spec},
    }  # fmt: skip
    path = net.folder / "specs" / "robot.yaml"
    path.parent.mkdir(exist_ok=True)
    with open(path, "w", encoding="utf-8") as file:
        YAML().dump(whole, file)
    return path


def fogspec(net: Net, words: list[str], patience_s: float = 1200.0, **extra: str) -> Ended:
    """Run fogspec to its end inside, with ROS 2's distribution and these environment variables, but without another start."""
    environment = net.environment(ROS_DISTRO="jazzy", **extra)

    def inside() -> None:
        os.environ.clear()
        os.environ.update(environment)
        net.enter()

    return forked(net.folder, words, first=inside, patience_s=patience_s)


def bench(
    net: Net, spec: dict[str, Any], timeout_s: float = 1200.0, **extra: str
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Compile and measure; returns the sample's record and its raw timings."""
    path = write_spec(net, spec)
    for words in (["compile", str(path)], ["bench", str(path), "--runner", "local", "--yes"]):
        ended = fogspec(net, words, timeout_s, **extra)
        assert ended.returncode in ((0,) if words[0] == "compile" else (0, 1, 4, 6)), ended.stdout + ended.stderr
        assert "Traceback" not in ended.stderr, ended.stderr
    return document(net.folder / "results" / "robot")["samples"][0], timings(net)


def timings(net: Net) -> list[dict[str, Any]]:
    """The raw timings of the sample that was measured."""
    kept = sorted((net.folder / "results" / "robot" / "timings").glob("*.jsonl.gz"))
    if not kept:
        return []
    (packed,) = kept
    text = subprocess.run(["gzip", "-dc", str(packed)], check=True, capture_output=True, text=True).stdout
    return [json.loads(line) for line in text.splitlines()]


def truth(path: Path) -> list[float]:
    """How long the node was really busy, a request each."""
    return [json.loads(line)["busy_s"] for line in path.read_text().splitlines()]
