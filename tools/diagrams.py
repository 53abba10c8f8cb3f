"""Draw the diagrams of the documentation: `python -m tools.diagrams [--check]` writes `docs/figures/diagram-*.svg`.

Each is one column of boxes, 400 px wide with text of 14 px, so that a phone shows it at full size and nothing is loaded from
another host.
"""

import sys
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from tools.generated import write_or_check

FIGURES = Path(__file__).resolve().parent.parent / "docs" / "figures"
WIDTH, MARGIN, LINE, PAD, GAP = 400, 12, 19, 10, 34
STYLE = """
text { font: 14px system-ui, sans-serif; fill: #1f2328 } .name { font-weight: 600 } .zone { font-weight: 600; fill: #57606a }
.box { fill: #ffffff; stroke: #57606a } .area { fill: #eef2f5; stroke: #8c959f; stroke-dasharray: 5 4 }
.arrow { stroke: #0b6e69; stroke-width: 2; fill: none } .tip { fill: #0b6e69 } .label { fill: #0b6e69 }
@media (prefers-color-scheme: dark) {
text { fill: #e6edf3 } .zone { fill: #9ea7b3 } .box { fill: #161b22; stroke: #9ea7b3 } .area { fill: #21262d; stroke: #6e7681 }
.arrow { stroke: #4fd1c5 } .tip { fill: #4fd1c5 } .label { fill: #4fd1c5 } }
"""


@dataclass(frozen=True)
class Box:
    """A box: its name, lines below it, and what the arrow to the next box carries (one line each)."""

    name: str
    lines: tuple[str, ...] = ()
    arrow: tuple[str, ...] | None = ()
    both_ways: bool = False


@dataclass(frozen=True)
class Zone:
    """Boxes that are in one place; a zone without a title has no frame."""

    title: str
    boxes: tuple[Box, ...] = field(default=())


DIAGRAMS: dict[str, tuple[str, tuple[Zone, ...]]] = {
    "pipeline": (
        "From a spec to a deployment: each stage is a file that you can review",
        (
            Zone("", (
                Box("specs/NAME.yaml", ("nodes, probe, limits, budget: you write it",), ("compile (free)",)),
                Box("plan.yaml and tasks/", ("machines to measure, maximum cost",), ("bench (costs money)",)),
                Box("results/NAME.yaml", ("latency of each sample, raw timings",), ("compile (free)",)),
                Box("models.yaml", ("predictions with 90% intervals",), ("compile (free)",)),
                Box("menu.yaml, menu.svg", ("every candidate against the limits",), ("compile (free)",)),
                Box("manifest.yaml", ("one machine, price, digests of all inputs",), ("review, then apply (costs money)",)),
                Box("deployment", ("status: observed against predicted", "down: tear down and verify"), None),
            )),
        ),
    ),
    "link": (
        "A zenoh link: two routers that know each other by key, one TCP port",
        (
            Zone("robot", (
                Box("robot nodes", ("robot.launch.py",), ("localhost",), both_ways=True),
                Box("router: robot.json5", ("private key in ~/.fogspec/links, never sent",),
                    ("mutual TLS, TCP 7448:", "only topics, services and actions of the spec"), both_ways=True),
            )),
            Zone("cloud machine", (
                Box("router: cloud.json5", ("its own private key, never sent",), ("localhost",), both_ways=True),
                Box("cloud nodes", ("cloud.launch.py, timed by the agent",), None),
            )),
        ),
    ),
    "security": (
        "What crosses the boundary between your computer and a machine",
        (
            Zone("pull request", (
                Box("spec, launch files", ("data: read, never run", "names of secrets, no values"), ("validate, compile",)),
                Box("manifest and tasks", ("reviewed; every file with its digest",), ("bench, apply: only what was reviewed",)),
            )),
            Zone("your computer, or CI", (
                Box("fogspec", ("compares task, price, files, images again",), ("SkyPilot: task, snapshot of files",)),
                Box("environment", ("values of secrets",), ("a file of mode 0600,", "removed before a node starts")),
            )),
            Zone("machine: may be hostile", (
                Box("agent, nodes", ("ends by itself; secrets are removed from logs",),
                    ("back: text, at most 256 MiB,", "each figure within a range")),
            )),
            Zone("your computer, or CI", (Box("results/NAME.yaml", ("checksum; verify recomputes every file",), None),)),
        ),
    ),
}  # fmt: skip


def drawn(title: str, zones: tuple[Zone, ...]) -> str:
    """Return a diagram as SVG."""
    areas: list[str] = []
    parts: list[str] = []
    y = MARGIN
    for zone in zones:
        top, inset, shapes = y, MARGIN * (2 if zone.title else 1), []
        if zone.title:
            y += LINE + PAD
            shapes.append(_text("zone", inset + 42, top + LINE, zone.title))
        for number, box in enumerate(zone.boxes):
            height = LINE * (1 + len(box.lines)) + PAD
            shapes.append(
                f'<rect class="box" x="{inset}" y="{y}" width="{WIDTH - 2 * inset}" height="{height}" rx="6"/>'
            )
            shapes.append(_text("name", inset + PAD, y + LINE, box.name))
            shapes += [_text("", inset + PAD, y + LINE * (n + 2), line) for n, line in enumerate(box.lines)]
            y += height
            if box.arrow is None:
                continue
            last = number == len(zone.boxes) - 1
            down = GAP + LINE * (len(box.arrow) - 1) + (MARGIN + LINE + PAD if last else 0)
            shapes.append(f'<path class="arrow" d="M{inset + 24} {y + (7 if box.both_ways else 0)}V{y + down - 7}"/>')
            tips = [f"M{inset + 18} {y + down - 8}h12l-6 8z"]
            tips += [f"M{inset + 18} {y + 8}h12l-6 -8z"] if box.both_ways else []
            shapes.append(f'<path class="tip" d="{"".join(tips)}"/>')
            start = y + LINE + 3 + (MARGIN if last and zone.title else 0)
            shapes += [_text("label", inset + 42, start + LINE * n, line) for n, line in enumerate(box.arrow)]
            y += GAP + LINE * (len(box.arrow) - 1)
        if zone.title:
            tail = zone.boxes[-1].arrow
            end = y - (GAP + LINE * (len(tail) - 1) if tail is not None else 0) + PAD
            areas.append(
                f'<rect class="area" x="{MARGIN / 2:g}" y="{top}" width="{WIDTH - MARGIN}" height="{end - top}" rx="8"/>'
            )
            y = y + MARGIN if tail is not None else end
        parts += shapes
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y + MARGIN}" width="{WIDTH}" height="{y + MARGIN}"'
    return (
        f'{head} role="img">\n<title>{escape(title)}</title>\n<style>{STYLE}</style>\n'
        + "\n".join([*areas, *parts])
        + "\n</svg>\n"
    )


def _text(kind: str, x: float, y: float, words: str) -> str:
    return f'<text class="{kind}" x="{x}" y="{y - 2}">{escape(words)}</text>'


def main() -> int:
    """Write the diagrams, or compare them with `--check`."""
    files = {FIGURES / f"diagram-{name}.svg": drawn(*one) for name, one in DIAGRAMS.items()}
    return write_or_check(files, sys.argv[1:], "python -m tools.diagrams")


if __name__ == "__main__":
    sys.exit(main())
