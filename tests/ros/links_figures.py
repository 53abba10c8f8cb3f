"""What a link costs: `python -m tests.ros.links_figures`. Needs root, `make ros-env` and the programs of the links.

Round trips of an empty request and of 1 MiB there and back: robot and cloud as two network namespaces joined by nothing
but the link, against the same programs in one namespace without a link: zenoh over plain TCP on loopback, ROS 2's default
middleware in its own way, which is shared memory for what is large. Each is measured in three rounds by turns, and the
calmest round is told, because other work on the computer only makes it slower.
"""

import argparse
import json
import statistics
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

from tests.ros.joined import Joined, joined, until
from tests.ros.namespaces import PYTHON
from tests.ros.quoting import host, quote

NODES = Path(__file__).parent / "nodes"
COUNT, MIB = 100, 1 << 20
ROUNDS = 3


def environment(both: Joined, link: str, side: str, joined_by_link: bool) -> dict[str, str]:
    """What the programs see: the link's environment, or ROS 2's own way in a domain of its own."""
    if link == "zenoh":
        return {}
    return both.environment(side) if joined_by_link else {"ROS_DOMAIN_ID": str(both.nets[side].domain + 100)}


def measured(both: Joined, link: str, joined_by_link: bool, size: int) -> list[float]:
    """Round trips in seconds, from the robot to the cloud or within the cloud."""
    program = str(NODES / {"zenoh": "over_zenoh.py", "wireguard": "tunnel.py"}[link])
    side = "robot" if joined_by_link else "cloud"
    count = COUNT if size < MIB else COUNT // 4
    words = [str(PYTHON), program, "times", str(count), str(size)]
    run = both.nets[side].run(words, 180, **environment(both, link, side, joined_by_link))
    if run.returncode != 0:
        raise RuntimeError(run.stderr[-2000:])
    return list(json.loads(run.stdout.splitlines()[-1]))


def figures(link: str) -> dict[str, Any]:
    """Median and 95th percentile of the small round trip in ms, and MiB/s with large ones, without and with the link."""
    with tempfile.TemporaryDirectory() as folder, joined(Path(folder), link) as both:
        both.exchange()
        both.firewall()
        both.up("cloud")
        both.up("robot")
        words = ["over_zenoh.py", "serve", "0"] if link == "zenoh" else ["tunnel.py", "echo"]
        for by_link in (True,) if link == "zenoh" else (True, False):
            sees = environment(both, link, "cloud", by_link)
            served = both.nets["cloud"].python(f"served-{by_link}", str(NODES / words[0]), *words[1:], **sees)
            if not until(lambda one=served: "up" in one.said()):
                raise RuntimeError(served.said())
        took: dict[tuple[bool, int], list[list[float]]] = {}
        for _ in range(ROUNDS):
            for by_link, size in product((False, True), (0, MIB)):
                took.setdefault((by_link, size), []).append(measured(both, link, by_link, size))
        return {name: _row(*(min(took[by_link, size], key=statistics.median) for size in (0, MIB)))
                for name, by_link in (("without", False), ("with", True))}  # fmt: skip


def _row(small: list[float], large: list[float]) -> dict[str, float]:
    return {
        "p50_ms": statistics.median(small) * 1e3,
        "p95_ms": statistics.quantiles(small, n=20)[-1] * 1e3,
        "mib_per_s": 2 / statistics.median(large),
    }


def lines() -> list[str]:
    """The table, a link a line."""
    said = [f"{'link':<10} {'p50':>9} {'p95':>9} {'1 MiB':>10}   {'p50':>9} {'p95':>9} {'1 MiB':>10}   {'added p50':>10}",
            f"{'':<10} {'without':>30}   {'with':>30}"]  # fmt: skip
    for link in ("zenoh", "wireguard"):
        found = figures(link)
        cells = [
            f"{one['p50_ms']:6.2f} ms {one['p95_ms']:6.2f} ms {one['mib_per_s']:4.0f} MiB/s" for one in found.values()
        ]
        added = found["with"]["p50_ms"] - found["without"]["p50_ms"]
        said.append(f"{link:<10} {cells[0]}   {cells[1]}   {added:+7.2f} ms")
    return said


def main() -> None:
    """Print the table, and put it into the page that quotes it if asked to."""
    parser = argparse.ArgumentParser(prog="python -m tests.ros.links_figures")
    parser.add_argument("--write", action="store_true", help="into the page that quotes them, too")
    options = parser.parse_args()
    found = [host(), *lines()]
    print("\n".join(found))
    if options.write:
        quote(parser.prog, found)


if __name__ == "__main__":
    main()
