"""How good the choices are, measured on tests/data/sparecores and shown in README and docs.

`python -m tests.tools.quality --measure` replays every method on the suite (minutes) and writes scores.json beside it, with
the seed and the digest of the suite. Without it the tables are written from that file; `--check` compares them, and the digest
with the suite. A slow test replays a part again.
"""

import hashlib
import json
import re
import sys
from pathlib import Path
from typing import Any

from fogspec.base.units import money
from fogspec.evaluation.campaign import Campaign, by_kind, evaluate, evaluate_volumes
from fogspec.evaluation.suites import KINDS
from tools.generated import ROOT, write_or_check

SUITE = ROOT / "tests" / "data" / "sparecores"
SCORES = SUITE / "scores.json"
PAGE = ROOT / "docs" / "explanation" / "how-good.md"
README = ROOT / "README.md"
SEED = 0
ROWS = (  # name, sampler, method
    ("the paper as it is: its grid, best R², nearest neighbours", "grid", "paper"),
    ("the paper's grid, read by our model", "grid", None),
    ("CherryPick-like: expected improvement, stop at 10%", "cherrypick", None),
    ("**fogspec**", "adaptive", None),
    ("a full sweep under the same rule", "full", "verified"),
    ("only the best machine (an oracle)", "best", None),
)
SHORT = (0, 2, 3, 4)  # of the rows, in README
TITLES = {"family": "one generation of machines", "gpu": "GPU and CPU machines"}
VOLUMES_OF = ("family", "gpu")
TABLE = re.compile(r"(<!-- quality -->\n).*?(<!-- /quality -->\n)", re.DOTALL)


def digest() -> str:
    """Return the digest of the suite's files."""
    files = (SUITE / name for name in ("machines.csv", "latencies.csv", "problems.jsonl"))
    return "sha256:" + hashlib.sha256(b"\0".join(one.read_bytes() for one in files)).hexdigest()


def measured() -> dict[str, Any]:
    """Replay every method on the suite, without a library."""
    campaigns = [Campaign(sampler, method, seed=SEED) for _, sampler, method in ROWS]
    results, _ = evaluate(SUITE, None, [], campaigns)
    found = {name: by_kind(some)[0] for (name, *_), some in zip(ROWS, results, strict=True)}
    volumes = evaluate_volumes(SUITE, None, VOLUMES_OF, SEED, "realistic")
    rounded = json.loads(
        json.dumps({"rows": found, "volumes": volumes}), parse_float=lambda text: float(f"{float(text):.4g}")
    )
    return {"suite": digest(), "seed": SEED, **rounded}


def files() -> dict[Path, str]:
    """Return README and the page with the tables of the scores."""
    scores = json.loads(SCORES.read_text("utf-8"))
    return {
        PAGE: _with(PAGE, "".join(_table(scores, kind) for kind in KINDS if kind in TITLES) + _volumes(scores)),
        README: _with(README, _short(scores)),
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
        '| | good | price of a sweep | samples | limit broken | wrong "none" | coverage |',
        "|--|--|--|--|--|--|--|",
    ]
    for name, *_ in ROWS:
        one = _row(scores, name, kind)
        covered = "-" if one["coverage90"] is None else _percent(one["coverage90"], 0)
        shares = [_percent(one[key], 1) for key in ("violation5", "false_infeasible")]
        lines.append(
            f"| {name} | {_percent(one['ok5'], 1)} | {_percent(one['bench'], 1 if one['bench'] > 0.1 else 2)} | "
            f"{one['samples']:.1f} | {' | '.join(shares)} | {covered} |"
        )
    return "\n".join([*lines, "", ""])


def _volumes(scores: dict[str, Any]) -> str:
    rows, kinds = scores["volumes"], VOLUMES_OF
    lines = [
        "### For a volume of requests",
        "",
        "| requests | " + " | ".join(f"{TITLES[kind]}: ours, best fixed (samples)" for kind in kinds) + " |",
        "|--|" + "--|" * len(kinds),
    ]
    for requests in sorted({one["requests"] for one in rows}):
        cells = []
        for kind in kinds:
            one = next(row for row in rows if (row["kind"], row["requests"]) == (kind, requests))
            least = one["fixed_usd"][str(one["best_size"])]
            cells.append(f"{money(one['own_usd'])}, {money(least)} ({one['best_size']})")
        lines.append(f"| {requests:,.0f} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def _short(scores: dict[str, Any]) -> str:
    kinds = [kind for kind in KINDS if kind in TITLES]
    lines = ["| good choices, for that share of the price of measuring all | " + " | ".join(TITLES[k] for k in kinds) + " |",
             "|--|" + "--|" * len(kinds)]  # fmt: skip
    for i in SHORT:
        cells = [_row(scores, ROWS[i][0], kind) for kind in kinds]
        texts = [
            f"{_percent(one['ok5'], 0)} for {_percent(one['bench'], 0 if one['bench'] > 0.1 else 1)}" for one in cells
        ]
        lines.append(f"| {ROWS[i][0]} | {' | '.join(texts)} |")
    return "\n".join([*lines, ""])


def _percent(share: float, digits: int) -> str:
    return f"{100 * share:.{digits}f}%"


def main(arguments: list[str]) -> int:
    """Measure, write or check."""
    if "--measure" in arguments:
        SCORES.write_text(json.dumps(measured(), indent=1) + "\n", "utf-8")
        arguments = []
    if json.loads(SCORES.read_text("utf-8"))["suite"] != digest():
        print(f"{SCORES.relative_to(ROOT)} is of another suite: python -m tests.tools.quality --measure")
        return 3
    return write_or_check(files(), arguments, "python -m tests.tools.quality")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
