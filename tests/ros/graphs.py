"""Graphs of real ROS 2 nodes with known times, and what `init --from-graph` should find in each: `python -m tests.ros.graphs`.

For each graph: the pairs of request and response that exist, how many were found, how many were proposed that do not exist,
the error of the median latency against what the nodes wrote down themselves, and the part of a core that watching took.
`--keep` writes what was seen and what was true to tests/cases/graph, where a test judges it without any node or clock.
"""

import argparse
import gzip
import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec.importers.graph.observed import Observed, read_observed
from fogspec.importers.graph.offers import timed_calls
from fogspec.importers.graph.pairs import Pair, find_pairs
from tests.ros.namespaces import Net, lacking, network
from tests.ros.quoting import host
from tests.support.agent import AGENT

NODES = Path(__file__).parent / "nodes"
RECORDED = Path(__file__).parents[1] / "cases" / "graph" / "recorded.json.gz"


def source(topic: str, kind: str, rate: float, **more: Any) -> dict[str, Any]:
    """Return a node that publishes at a rate; `topics` has further ones of the same moments."""
    size = more.pop("size", 1000)
    topics = [{"topic": topic, "kind": kind, "size": size}, *more.pop("topics", [])]
    return {"node": f"source{topic.replace('/', '_')}", "sends": [{"rate": rate, "topics": topics, **more}]}


def worker(
    request: str, response: str, busy: float, of: str = "image", kind: str = "pose", **more: Any
) -> dict[str, Any]:
    """Return a node that answers one topic on another."""
    part = {"request": request, "response": response, "busy": busy, "of": of, "kind": kind, **more}
    return {"node": f"worker{response.replace('/', '_')}", "answers": [part]}


def ticker(reads: dict[str, str], topic: str, kind: str, rate: float, **more: Any) -> dict[str, Any]:
    """Return a decoy: it reads topics, and publishes by a timer of its own."""
    sends = [{"rate": rate, "topics": [{"topic": topic, "kind": kind}], **more}]
    reads_only = [
        {"request": name, "response": f"{topic}_never", "busy": 0, "loss": 1.0, "of": of, "kind": "text"}
        for name, of in reads.items()
    ]
    return {"node": f"ticker{topic.replace('/', '_')}", "answers": reads_only, "sends": sends}


Graph = tuple[list[dict[str, Any]], set[tuple[str, str]]]
POSE = {("/rgb", "/pose")}
GRAPHS: dict[str, Graph] = {
    "one node, stamps": ([source("/rgb", "image", 10), worker("/rgb", "/pose", 0.05)], POSE),
    "no stamps": ([source("/rgb", "text", 10), worker("/rgb", "/pose", 0.05, "text", "text")], POSE),
    "responses with stamps of their own": (
        [source("/rgb", "image", 10), worker("/rgb", "/pose", 0.05, stamp=False)], POSE),
    "saturated, stamps": ([source("/rgb", "image", 20), worker("/rgb", "/pose", 0.06, depth=1)], POSE),
    "requests lost, stamps": ([source("/rgb", "image", 20), worker("/rgb", "/pose", 0.03, loss=0.1)], POSE),
    "requests lost, no stamps": (
        [source("/rgb", "text", 10), worker("/rgb", "/pose", 0.04, "text", "text", loss=0.1)], POSE),
    "source that skips, no stamps": (
        [source("/rgb", "text", 12, loss=0.15), worker("/rgb", "/pose", 0.04, "text", "text")], POSE),
    "reordered, stamps": (
        [source("/rgb", "image", 20), worker("/rgb", "/pose", 0.08, threads=True, spread=0.7)], POSE),
    "a timer of the same rate": (
        [source("/rgb", "image", 10), worker("/rgb", "/pose", 0.05), ticker({"/rgb": "image"}, "/status", "text", 10)],
        POSE),
    "only a timer of the same rate": ([source("/rgb", "text", 10), ticker({"/rgb": "text"}, "/status", "text", 10)], set()),
    "a timer with stamps of its own": (
        [source("/rgb", "image", 10), ticker({"/rgb": "image"}, "/status", "pose", 10)], set()),
    "a timer of twice the rate": (
        [source("/rgb", "text", 10), worker("/rgb", "/pose", 0.03, "text", "text"),
         ticker({"/rgb": "text"}, "/beat", "text", 20)], POSE),
    "a latched map": (
        [source("/rgb", "image", 10), {"node": "maps", "latched": [{"topic": "/map", "kind": "image"}]},
         worker("/rgb", "/pose", 0.05, also={"/map": "image"})], POSE),
    "pipeline, stamps kept": (
        [source("/raw", "image", 10), worker("/raw", "/rgb", 0.02, kind="image"), worker("/rgb", "/pose", 0.05)],
        {("/raw", "/rgb"), ("/rgb", "/pose")}),
    "pipeline, stamped again": (
        [source("/raw", "image", 10), worker("/raw", "/rgb", 0.02, kind="image", stamp=False),
         worker("/rgb", "/pose", 0.05)], {("/raw", "/rgb"), ("/rgb", "/pose")}),
    "pipeline, stamped again twice": (
        [source("/raw", "image", 10), worker("/raw", "/rgb", 0.02, kind="image", stamp=False),
         worker("/rgb", "/pose", 0.04, stamp=False)], {("/raw", "/rgb"), ("/rgb", "/pose")}),
    "image and camera_info": (
        [source("/rgb", "image", 10, size=60_000, topics=[{"topic": "/camera_info", "kind": "image", "size": 300}]),
         worker("/rgb", "/pose", 0.05, also={"/camera_info": "image"})], POSE),
    "a sensor of a higher rate": (
        [source("/rgb", "image", 10), source("/imu", "pose", 100),
         worker("/rgb", "/pose", 0.05, also={"/imu": "pose"})], POSE),
    "a sensor of a higher rate, no stamps": (
        [source("/rgb", "text", 10), source("/imu", "text", 50),
         worker("/rgb", "/pose", 0.05, "text", "text", also={"/imu": "text"})], POSE),
    "two workers of one image": (
        [source("/rgb", "image", 10), worker("/rgb", "/pose", 0.05), worker("/rgb", "/boxes", 0.03)],
        {("/rgb", "/pose"), ("/rgb", "/boxes")}),
    "random requests, no stamps": (
        [source("/goal", "text", 4, random=True), worker("/goal", "/path", 0.08, "text", "text")], {("/goal", "/path")}),
    "random work, no stamps": (
        [source("/goal", "text", 5), worker("/goal", "/path", 0.1, "text", "text", spread=0.6)], {("/goal", "/path")}),
    "large images, best effort": (
        [source("/rgb", "image", 10, size=900_000), worker("/rgb", "/pose", 0.06, best_effort=True)], POSE),
    "a queue, no stamps": (
        [source("/rgb", "text", 8, jitter=0.09), worker("/rgb", "/pose", 0.1, "text", "text")], POSE),
    "an action and a service": (
        [{"node": "navigator", "acts": [{"action": "/navigate", "busy": 0.3}]},
         {"node": "planner", "serves": [{"service": "/plan", "busy": 0.1}]},
         {"node": "mission", "calls": [{"action": "/navigate", "every": 1.0}, {"service": "/plan", "every": 0.7}]}],
        {("/navigate", "/navigate")}),
    "a service that publishes its calls": (
        [{"node": "planner", "serves": [{"service": "/plan", "busy": 0.1, "introspected": True}]},
         {"node": "mission", "calls": [{"service": "/plan", "every": 0.4}]}], {("/plan", "/plan")}),
    "nothing but timers": (
        [source("/a", "text", 10), source("/b", "pose", 10), ticker({"/a": "text", "/b": "pose"}, "/c", "pose", 10)], set()),
}  # fmt: skip


@dataclass(frozen=True)
class Score:
    """What was found in one graph; errors are relative, of the median of each pair that was found."""

    expected: set[tuple[str, str]]
    found: list[Pair]
    proposed: set[tuple[str, str]]
    errors: dict[tuple[str, str], float]
    cpu: float

    @property
    def right(self) -> set[tuple[str, str]]:
        """The pairs that exist and were found."""
        return self.expected & self.proposed

    @property
    def wrong(self) -> set[tuple[str, str]]:
        """The pairs that were proposed and do not exist."""
        return self.proposed - self.expected


True_s = dict[tuple[str, str], float]  # median latency of each pair, by the nodes' own times


def observe(net: Net, graph: list[dict[str, Any]], seconds: float) -> tuple[Observed, True_s]:
    """Run the graph and watch it; returns what was seen, and what was true in that time."""
    truth, out = net.folder / "truth", net.folder / "robot.json"
    robot = net.python("robot", str(NODES / "graph.py"), json.dumps(graph), str(truth))
    while "ready" not in robot.said():
        assert robot.popen.poll() is None, robot.said()
        time.sleep(0.1)
    watched = net.run(["python3", str(AGENT), "watch", "--for", str(seconds), "--out", str(out)], seconds + 600)
    assert watched.returncode == 0, watched.stderr + robot.said()
    robot.stop()
    assert out.exists(), watched.stderr
    seen, told = read_observed(out), truth.read_text().splitlines() if truth.exists() else []
    since = min((at for topic in seen.topics.values() for at, *_ in topic.messages[:1]), default=0)
    took: dict[tuple[str, str], list[float]] = {}
    for request, response, begun, ended in map(json.loads, told[:-1]):
        if begun >= since:
            took.setdefault((request, response), []).append((ended - begun) * 1e-9)
    return seen, {pair: statistics.median(times) for pair, times in took.items()}


def kept(seen: Observed, true_s: True_s) -> dict[str, Any]:
    """Return a run as data for `recorded`, without what it says of this computer."""
    data = seen.model_dump(mode="json", exclude={"machine": True, "nodes": {"__all__": {"process"}}})
    return {"seen": data, "true_s": {" ".join(pair): round(value, 9) for pair, value in sorted(true_s.items())}}


def recorded() -> dict[str, tuple[Observed, True_s]]:
    """Return the runs that are kept in the repository, by the graph's name."""
    found = json.loads(gzip.decompress(RECORDED.read_bytes()))
    return {
        name: (Observed.model_validate(one["seen"]), {tuple(k.split()): v for k, v in one["true_s"].items()})
        for name, one in found.items()
    }


def score(seen: Observed, true_s: True_s, expected: set[tuple[str, str]]) -> Score:
    """Compare what is proposed with what exists."""
    found = find_pairs(seen)
    read = {(one.request, one.response): one.p50_s for one in found}
    read |= {(one.name, one.name): one.p50_s for one in timed_calls(seen)}
    errors = {pair: read[pair] / true_s[pair] - 1 for pair in set(read) & expected}
    return Score(expected, found, set(read), errors, seen.overhead.cpu)


def runs(names: list[str], seconds: float) -> Iterator[tuple[str, Observed, True_s]]:
    """Watch each graph in a network of its own."""
    for name in names:
        with tempfile.TemporaryDirectory() as folder, network(Path(folder)) as net:
            yield name, *observe(net, GRAPHS[name][0], seconds)


def main() -> None:
    """Print one line for each graph, and the sums."""
    parser = argparse.ArgumentParser(prog="python -m tests.ros.graphs")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--keep", action="store_true", help="keep the runs in the repository, in place of those there")
    parser.add_argument("graphs", nargs="*", metavar="GRAPH", help="; ".join(GRAPHS))
    options = parser.parse_args()
    if reason := lacking():
        raise SystemExit(reason)
    print(host(), f"{'graph':<40}{'right':>7}{'wrong':>7}{'error %':>9}{'CPU %':>7}", sep="\n")
    scores, all_kept = [], json.loads(gzip.decompress(RECORDED.read_bytes())) if RECORDED.exists() else {}
    for name, seen, true_s in runs(options.graphs or [*GRAPHS], options.seconds):
        one = score(seen, true_s, GRAPHS[name][1])
        if options.keep:
            all_kept[name] = kept(seen, true_s)
            RECORDED.write_bytes(gzip.compress(json.dumps(all_kept, separators=(",", ":")).encode(), 9, mtime=0))
        worst = max(one.errors.values(), key=abs, default=0.0)
        print(
            f"{name:<40}{len(one.right):>4}/{len(one.expected)}{len(one.wrong):>7}{100 * worst:>9.2f}{100 * one.cpu:>7.1f}",
            flush=True,
        )
        for pair in one.found:
            print(f"    {pair.evidence()}", flush=True)
        scores.append(one)
    expected, right = sum(len(one.expected) for one in scores), sum(len(one.right) for one in scores)
    wrong = sum(len(one.wrong) for one in scores)
    errors = [abs(error) for one in scores for error in one.errors.values()]
    print(f"{len(scores)} graphs: {right} of {expected} pairs found, {wrong} proposed that do not exist; error of the median "
          f"latency: median {100 * statistics.median(errors or [0]):.2f}%, largest {100 * max(errors or [0]):.2f}%; "
          f"CPU of the watcher: median {100 * statistics.median(one.cpu for one in scores):.1f}% of a core")  # fmt: skip


if __name__ == "__main__":
    main()
