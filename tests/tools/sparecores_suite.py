"""The evaluation data in tests/data/sparecores/: 32 problems on real measurements, from a larger set that is not here.

`python -m tests.tools.sparecores_suite FOLDER` picks them from a folder in the layout of `fogspec evaluate --suite`, by kind,
in an order by digest of their ids, so that nobody chose them. Only latencies that they need are taken. What the files hold,
from where, and under which licence: tests/data/sparecores/README.md.
"""

import csv
import gzip
import hashlib
import io
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tools.generated import write_or_check

FOLDER = Path(__file__).resolve().parents[1] / "data" / "sparecores"
COUNTS = {"family": 24, "gpu": 8}

Row = dict[str, Any]


def files(source: Path) -> dict[Path, str]:
    """Return the text of every file by its path."""
    everything = [json.loads(line) for line in _text(source, "problems.jsonl").splitlines()]
    problems = [one for kind, count in COUNTS.items() for one in _picked(everything, kind, count)]
    needed = {(one["workload"], name) for one in problems for name in one["machines"]}
    latencies = [one for one in _rows(source, "latencies.csv") if (one["workload"], _name(one)) in needed]
    names = {name for _, name in needed}
    machines = [one for one in _rows(source, "machines.csv") if _name(one, "Cloud", "InstanceType") in names]
    return {
        FOLDER / "machines.csv": _csv(machines),
        FOLDER / "latencies.csv": _csv(latencies),
        FOLDER / "problems.jsonl": "".join(json.dumps(one) + "\n" for one in problems),
    }


def _picked(problems: Sequence[Row], kind: str, count: int) -> list[Row]:
    """Return problems of a kind, in turn one of each suite of programs."""
    left = sorted((one for one in problems if one["kind"] == kind), key=lambda one: _order(one["id"]))
    by_suite: dict[str, list[Row]] = {}
    for one in left:
        by_suite.setdefault(one["workload"].partition("_")[0], []).append(one)
    found: list[Row] = []
    while len(found) < count and any(by_suite.values()):
        found += [some.pop(0) for some in by_suite.values() if some]
    return found[:count]


def _order(identifier: str) -> str:
    return hashlib.sha256(identifier.encode()).hexdigest()


def _name(row: Row, cloud: str = "cloud", instance: str = "instance_type") -> str:
    return f"{row[cloud]}/{row[instance]}"


def _rows(source: Path, name: str) -> Iterator[Row]:
    yield from csv.DictReader(io.StringIO(_text(source, name)))


def _text(source: Path, name: str) -> str:
    path = source / name
    return path.read_text("utf-8") if path.is_file() else gzip.decompress((source / f"{name}.gz").read_bytes()).decode()


def _csv(rows: list[Row]) -> str:
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, tuple(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


if __name__ == "__main__":
    sys.exit(write_or_check(files(Path(sys.argv[1])), sys.argv[2:], "python -m tests.tools.sparecores_suite FOLDER"))
