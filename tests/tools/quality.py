"""How good the choices are, measured on tests/data/sparecores and shown in README and docs.

`python -m tests.tools.quality --measure` replays every method on the suite (many minutes) and writes scores.json beside it,
with the seeds and the digest of the suite; words behind it are the rows to replay again, by a part of their name. Without it
the tables and the chart are written from that file; `--check` compares them, and the digest with the suite. A slow test replays
a part again.
"""

import hashlib
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from fogspec.charts.picture import Axis, Dot, Frame, picture
from fogspec_lab.evaluation.campaign import Campaign, Result, by_kind, evaluate
from fogspec_lab.evaluation.suites import KINDS
from fogspec_lab.generated import ROOT, write_or_check

SUITE = ROOT / "tests" / "data" / "sparecores"
SCORES = SUITE / "scores.json"
PAGE = ROOT / "docs" / "explanation" / "how-good.md"
CHART = PAGE.with_suffix(".svg")
README = ROOT / "README.md"
SEEDS = (0, 1, 2)
LIBRARY = "built-in"
OURS = "**fogspec**"
ROWS = (  # name, in the chart and README, its hue there, sampler, method, library
    ("the paper as it is: its grid, best R², nearest neighbours", "the paper", "broken", "grid", "paper", None),
    ("CherryPick-like: expected improvement, stop at 10%", "CherryPick-like", "gpu-1", "cherrypick", None, None),
    ("nine machines at random, read by our model", "random", "gpu-2", "random", None, LIBRARY),
    (OURS, "fogspec", "chosen", "adaptive", None, LIBRARY),
    ("fogspec without its machine library", "", "", "adaptive", None, None),
    ("a full sweep, read by its measured values", "sweep", "ink", "full", None, None),
    ("only the best machine (an oracle)", "", "", "best", None, None),
)
PATHS = ("cherrypick", "random", "adaptive")  # samplers whose choice changes on the way
SHARES = np.geomspace(0.003, 1, 26)  # of the price of a sweep
LEAST = 0.02  # good choices that are drawn
TITLES = {"family": "one generation of machines", "gpu": "GPU and CPU machines", "multicloud": "several clouds"}
TABLE = re.compile(r"(<!-- quality -->\n).*?(<!-- /quality -->\n)", re.DOTALL)


def digest() -> str:
    """Return the digest of the suite's files."""
    files = (SUITE / name for name in ("machines.csv", "latencies.csv", "problems.jsonl"))
    return "sha256:" + hashlib.sha256(b"\0".join(one.read_bytes() for one in files)).hexdigest()


def measure(words: list[str]) -> None:
    """Replay the rows with one of these words in their name, all without words; each is written when it ends."""
    for name, _, _, sampler, method, library in ROWS:
        if words and not any(word in name for word in words):
            continue
        first = Campaign(sampler, method, seed=SEEDS[0], path=sampler in PATHS)
        campaigns = [first, *(Campaign(sampler, method, seed=seed) for seed in SEEDS[1:])]
        results = [one for ended in evaluate(SUITE, library, [], campaigns) for one in ended]
        curves = {kind: curve([one for one in results if one.path and one.score.kind == kind]) for kind in TITLES}
        rows = json.loads(SCORES.read_text("utf-8"))["rows"]
        rows[name] = [row | {"curve": curves[row["kind"]]} for row in by_kind(results)[0]]
        kept = {"suite": digest(), "seeds": SEEDS, "rows": {row[0]: rows[row[0]] for row in ROWS if row[0] in rows}}
        rounded = json.loads(json.dumps(kept), parse_float=lambda text: float(f"{float(text):.4g}"))
        SCORES.write_text(json.dumps(rounded, indent=1) + "\n", "utf-8")


def curve(results: list[Result]) -> list[float]:
    """Return the share of good choices for at most each of `SHARES`; before its first batch a method has none."""
    found = [
        [next((step.ok[1] for step in reversed(one.path) if step.bench <= share), False) for share in SHARES]
        for one in results
    ]
    return [float(share) for share in np.mean(found, axis=0)] if found else []


def files() -> dict[Path, str]:
    """Return README and the page with the tables of the scores, and the chart."""
    scores = json.loads(SCORES.read_text("utf-8"))
    kinds = [kind for kind in KINDS if kind in TITLES]
    return {
        PAGE: _with(PAGE, "".join(_table(scores, kind) for kind in kinds).rstrip("\n") + "\n"),
        README: _with(README, _short(scores, kinds)),
        CHART: _chart(scores, kinds),
    }


def _with(page: Path, table: str) -> str:
    return TABLE.sub(lambda found: f"{found[1]}{table}{found[2]}", page.read_text("utf-8"))


def _row(scores: dict[str, Any], name: str, kind: str) -> dict[str, Any]:
    found: dict[str, Any] = next(one for one in scores["rows"][name] if one["kind"] == kind)
    return found


def _table(scores: dict[str, Any], kind: str) -> str:
    count = _row(scores, ROWS[0][0], kind)["problems"]
    lines = [
        f"### {TITLES[kind][0].upper()}{TITLES[kind][1:]} ({count} problems)",
        "",
        "| | good | more than 20% off | mean regret | price of a sweep | dollars | hours | samples | limit broken | "
        'wrong "none" | coverage |',
        "|--|--|--|--|--|--|--|--|--|--|--|",
    ]
    for name, *_ in ROWS:
        one = _row(scores, name, kind)
        covered = "-" if one["coverage90"] is None else _percent(one["coverage90"], 0)
        shares = [1 - one["ok20"], one["regret"]["mean"]]
        cells = [
            f"{_percent(one['ok5'], 1)} ± {100 * one['error']['ok5']:.1f}",
            *(_percent(share, 1) for share in shares),
            f"{_percent(one['bench'], _digits(one))} ± {100 * one['error']['bench']:.{_digits(one)}f}",
            f"{one['usd']:.2f}",
            f"{one['hours']:.2f}",
            f"{one['samples']:.1f}",
            *(_percent(one[key], 1) for key in ("violation5", "false_infeasible")),
            covered,
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", ""])


def _short(scores: dict[str, Any], kinds: list[str]) -> str:
    lines = ["| good choices, price of a sweep, hours | " + " | ".join(TITLES[kind] for kind in kinds) + " |",
             "|--|" + "--|" * len(kinds)]  # fmt: skip
    for name in (row[0] for row in ROWS if row[1]):
        cells = [_row(scores, name, kind) for kind in kinds]
        texts = [
            f"{100 * one['ok5']:.0f} ± {100 * one['error']['ok5']:.0f}%, {_percent(one['bench'], _digits(one) - 1)}, "
            f"{one['hours']:.1f} h"
            for one in cells
        ]
        lines.append(f"| {name} | {' | '.join(texts)} |")
    return "\n".join([*lines, ""])


def _digits(row: dict[str, Any]) -> int:
    return 1 if row["bench"] > 0.1 else 2


def _chart(scores: dict[str, Any], kinds: list[str]) -> str:
    ours = _row(scores, OURS, kinds[0])
    return picture(
        f"{100 * ours['ok5']:.0f}% good choices for {100 * ours['bench']:.0f}% of a sweep's price in {TITLES[kinds[0]]}",
        [_frame(scores, kind) for kind in kinds if kind != "gpu"],
        keys=[("measured", "where a method ends by itself, on average"), ("curve", "had it been stopped before")],
        source="in-sample: fogspec was developed on a set that these problems are part of. Data: Spare Cores, CC BY-SA 4.0",
        columns=2,
    )


def _frame(scores: dict[str, Any], kind: str) -> Frame:
    dots, lines = [], []
    for name, short, hue, *_ in ROWS:
        if not short:
            continue
        row = _row(scores, name, kind)
        good, bench = 100 * max(row["ok5"], LEAST), 100 * row["bench"]
        title = f"{short}: {good:.0f}% good for {bench:.3g}%, {row['hours']:.1f} h"
        dots.append(Dot(title=title, x=bench, y=good, hue=hue, measured=True, name=short))
        seen = [(100 * x, 100 * y) for x, y in zip(SHARES, row["curve"], strict=False) if y >= LEAST]
        if seen:
            lines.append((f"curve {hue}", seen))
    xs, ys = ([value for _, some in lines for value in (one[i] for one in some)] for i in (0, 1))
    return Frame(
        x=Axis.over("price of a sweep", "{:g}%".format, [*xs, *(one.x for one in dots)]),
        y=Axis.over("good choices", "{:g}%".format, [*ys, *(one.y for one in dots), 100]),
        dots=dots,
        lines=lines,
        heading=TITLES[kind],
    )


def _percent(share: float, digits: int) -> str:
    return f"{100 * share:.{digits}f}%"


def main(arguments: list[str]) -> int:
    """Measure, write or check."""
    if "--measure" in arguments:
        measure([word for word in arguments if word != "--measure"])
        arguments = []
    if json.loads(SCORES.read_text("utf-8"))["suite"] != digest():
        print(f"{SCORES.relative_to(ROOT)} is of another suite: python -m tests.tools.quality --measure")
        return 3
    return write_or_check(files(), arguments, "python -m tests.tools.quality")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
