"""The evaluation data in tests/data/sparecores/: 38 problems on real measurements, from a larger set that is not here.

`python -m tests.tools.sparecores_suite FOLDER PRICES` picks 32 of them from a folder in the layout of `fogspec-lab evaluate
--suite`, by kind, in an order by digest of their ids, so that nobody chose them. Only latencies that they need are taken. Six
are made: machines of three clouds, whose times are the profiles of fogspec's own library, with the prices of a machines.csv.
One in `EVERY` machines is taken and one program of each suite in turn, by digest; limits and scales are quantiles of what the
machines have. What the files hold, from where, and under which licence: tests/data/sparecores/README.md.
"""

import csv
import gzip
import hashlib
import io
import json
import math
import statistics
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fogspec.model.library import built_in
from fogspec_lab.generated import write_or_check

FOLDER = Path(__file__).resolve().parents[1] / "data" / "sparecores"
COUNTS = {"family": 24, "gpu": 8}
CLOUDS = 6
FEWEST = 2000  # machines that a program of several clouds was measured on
EVERY = 8

Row = dict[str, Any]


def files(source: Path, prices: Path) -> dict[Path, str]:
    """Return the text of every file by its path."""
    everything = [json.loads(line) for line in _text(source, "problems.jsonl").splitlines()]
    problems = [one for kind, count in COUNTS.items() for one in _picked(everything, kind, count)]
    needed = {(one["workload"], name) for one in problems for name in one["machines"]}
    latencies = [one for one in _rows(source, "latencies.csv") if (one["workload"], _name(one)) in needed]
    priced = {_name(one, "Cloud", "InstanceType"): one for one in _rows(prices.parent, prices.name) if _plain(one)}
    for problem, rows in _several_clouds(priced):
        problems.append(problem)
        latencies += rows
    names = {name for one in problems for name in one["machines"]}
    known = {_name(one, "Cloud", "InstanceType"): one for one in _rows(source, "machines.csv")}
    return {
        FOLDER / "machines.csv": _csv([(priced | known)[name] for name in sorted(names)]),
        FOLDER / "latencies.csv": _csv(latencies),
        FOLDER / "problems.jsonl": "".join(json.dumps(one) + "\n" for one in problems),
    }


def _plain(machine: Row) -> bool:
    return not machine["AcceleratorName"] and machine["Burstable"] == "0" and float(machine["Price"]) > 0


def _several_clouds(priced: dict[str, Row]) -> Iterator[tuple[Row, list[Row]]]:
    """Yield problems over machines of three clouds, and their latencies."""
    library = built_in()
    taken = [i for i, name in enumerate(library.names) if name in priced and int(_order(name), 16) % EVERY == 0]
    measured = {
        library.workloads[i]: i for i, row in enumerate(library.log_latency) if sum(map(math.isfinite, row)) >= FEWEST
    }
    by_suite: dict[str, list[str]] = defaultdict(list)
    for workload in sorted(measured, key=_order):
        by_suite[library.suites[measured[workload]]].append(workload)
    for workload in _in_turn(list(by_suite.values()), CLOUDS):
        row = library.log_latency[measured[workload]]
        latency_s = {library.names[i]: float(f"{math.exp(row[i]):.5g}") for i in taken if math.isfinite(row[i])}
        suite, name = library.suites[measured[workload]], f"{workload} in several clouds"
        places = [one.partition("/")[::2] for one in latency_s]
        yield (
            _over(name, latency_s, priced),
            [
                {"workload": name, "suite": suite, "cloud": cloud, "instance_type": instance, "latency_s": str(seconds)}
                for (cloud, instance), seconds in zip(places, latency_s.values(), strict=True)
            ],
        )


def _over(workload: str, latency_s: dict[str, float], priced: dict[str, Row]) -> Row:
    cost = {name: float(priced[name]["Price"]) / 3600 * seconds for name, seconds in latency_s.items()}
    fast, cheap = (statistics.quantiles(some.values(), n=10, method="inclusive") for some in (latency_s, cost))
    settings = [
        ("a0", 0.0, None, None), ("a.5", 0.5, None, None), ("a1", 1.0, None, None), ("a0_L50", 0.0, fast[4], None),
        ("a0_L20", 0.0, fast[1], None), ("a1_C50", 1.0, None, cheap[4]), ("a1_C20", 1.0, None, cheap[1]),
    ]  # fmt: skip
    keys = ("name", "alpha", "max_latency_s", "max_cost_usd_per_request")
    return {
        "id": f"multicloud|{workload}",
        "kind": "multicloud",
        "workload": workload,
        "machines": list(latency_s),
        "scale": {"latency_s": fast[4], "cost_usd_per_request": cheap[4]},
        "settings": [dict(zip(keys, one, strict=True)) for one in settings],
    }


def _picked(problems: Sequence[Row], kind: str, count: int) -> list[Row]:
    """Return problems of a kind, in turn one of each suite of programs."""
    by_suite: dict[str, list[Row]] = defaultdict(list)
    for one in sorted((one for one in problems if one["kind"] == kind), key=lambda one: _order(one["id"])):
        by_suite[one["workload"].partition("_")[0]].append(one)
    return _in_turn(list(by_suite.values()), count)


def _in_turn(queues: list[list[Any]], count: int) -> list[Any]:
    found: list[Any] = []
    while len(found) < count and any(queues):
        found += [some.pop(0) for some in queues if some]
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
    sys.exit(
        write_or_check(
            files(*map(Path, sys.argv[1:3])), sys.argv[3:], "python -m tests.tools.sparecores_suite FOLDER PRICES"
        )
    )
