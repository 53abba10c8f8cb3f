"""What an editor shows from the schema alone, through a real yaml-language-server: `npm ci --prefix tests/editor`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.editor.server import SERVER, Server

ROOT = Path(__file__).resolve().parents[2]
SPECS = sorted((ROOT / "specs").glob("*.yaml"))
GRASP = (ROOT / "specs" / "grasp-planning-recorded.yaml").read_text("utf-8")


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    if not SERVER.exists():
        pytest.skip("needs yaml-language-server: npm ci --prefix tests/editor")
    with Server() as one:
        yield one


def lines(found: list[dict[str, Any]]) -> list[int]:
    return sorted({one["range"]["start"]["line"] for one in found})


@pytest.mark.parametrize("path", SPECS, ids=lambda path: path.stem)
def test_good_specs_have_nothing_underlined(server: Server, path: Path) -> None:
    assert server.mistakes(path, path.read_text("utf-8")) == []


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("shape", "infra: [aws/us-east-1]", "infra: aws/us-east-1"), ("enum", "sampler: grid", "sampler: gird"),
        ("range", "alpha: 0.7", "alpha: 7"), ("unit", "latency: 2s", "latency: 2"),
        ("unit of text", "latency: 2s", "latency: 2 parsecs"),
        ("cost", "cost: $0.001/request", "cost: $0.001"), ("memory", "memory: 4GiB..512GiB", "memory: 4..512"),
        ("unknown key", "latency: 2s", "latancy: 2s"), ("name", "name: grasp-planning-recorded", "name: Grasp_Planning"),
        ("number as text", "alpha: 0.7", "alpha: '0.7'"),
    ],
)  # fmt: skip
def test_broken_specs_are_underlined_at_the_line(server: Server, name: str, old: str, new: str) -> None:
    assert old in GRASP
    text = GRASP.replace(old, new, 1)
    line = text[: text.index(new)].count("\n")
    path = ROOT / "specs" / f"broken-{name.replace(' ', '-')}.yaml"
    assert lines(server.mistakes(path, text)) == [line]


def test_hover_and_completion_come_from_the_fields_own_words(server: Server) -> None:
    path = ROOT / "specs" / "taught.yaml"
    text = GRASP.replace("  objective:\n", "  objective:\n    \n", 1)
    server.mistakes(path, text)
    row = text.split("\n").index("    ")
    offered = {one["label"]: one for one in server.at("completion", path, row, 4)["items"]}
    assert {"metric", "scale", "load", "transfer"} <= set(offered)
    assert "only the seconds of a request are paid" in str(offered["load"]["documentation"])
    cost = next(i for i, line in enumerate(text.split("\n")) if line.strip().startswith("cost:"))
    assert "upper bound on the cost of one request" in str(server.at("hover", path, cost, 5))
