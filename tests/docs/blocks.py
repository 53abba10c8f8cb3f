"""Fenced blocks of a page, and what they ask for.

- `console`: lines behind `$ ` are commands, the lines below are what they print. A line `...` stands for any lines, `…` for
  any text in a line.
- `sh`: commands; what they print is not shown.
- Any other block with `title="a/path"` is a file that the reader writes.
- `<!-- not run: REASON -->` on the line before says to the tests, and not to the reader, that this block is not run, and why.
- `title="your figures will differ"` says that numbers in the output depend on the machine.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DIFFERS = "your figures will differ"
FENCE = re.compile(r"^(?P<indent> *)(?P<ticks>`{3,})(?P<language>[\w-]*)[ ]*(?P<rest>.*)$")
TITLE = re.compile(r'title="([^"]*)"')
NOT_RUN = re.compile(r" *<!-- not run: (.*) -->")


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block; `line` is that of its first line of text, counted from 1."""

    page: Path
    line: int
    language: str
    title: str
    text: str
    indent: str = ""
    not_run: str = ""

    @property
    def commands(self) -> bool:
        """Whether a reader types it."""
        return self.language in ("console", "sh")

    @property
    def run(self) -> bool:
        """Whether the tests run it."""
        return self.commands and not self.not_run

    @property
    def file(self) -> str:
        """The file that a reader writes it to, if any."""
        return "" if self.commands else self.title


@dataclass(frozen=True, slots=True)
class Step:
    """One command of a block, and what the page says it prints (None: nothing is said)."""

    block: Block
    line: int
    command: str
    shown: tuple[str, ...] | None


def pages() -> list[Path]:
    """README and every page that people write; generated ones have no commands."""
    written = [path for path in sorted((ROOT / "docs").rglob("*.md")) if "adr" not in path.parts]
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *written]


def blocks(page: Path) -> list[Block]:
    """The blocks of a page, in order; raises ValueError for one that is not closed."""
    found: list[Block] = []
    lines = page.read_text("utf-8").splitlines()
    number = 0
    while number < len(lines):
        opened = FENCE.match(lines[number])
        if opened is None:
            number += 1
            continue
        start = number + 1
        end = next((n for n in range(start, len(lines)) if lines[n].strip() == opened["ticks"]), None)
        if end is None:
            raise ValueError(f"{page}:{start}: a block is not closed")
        title = TITLE.search(opened["rest"])
        indent, why = opened["indent"], NOT_RUN.fullmatch(lines[number - 1])
        text = "\n".join(line.removeprefix(indent) for line in lines[start:end])
        found.append(
            Block(page, start + 1, opened["language"], title[1] if title else "", text, indent, why[1] if why else "")
        )
        number = end + 1
    return found


def steps(block: Block) -> Iterator[Step]:
    """The commands of a block."""
    if block.language == "sh":
        yield Step(block, block.line, block.text, None)
        return
    lines = block.text.splitlines()
    starts = [number for number, line in enumerate(lines) if line.startswith("$ ")]
    if not starts or starts[0] != 0:
        raise ValueError(f"{block.page}:{block.line}: a console block begins with a command behind '$ '")
    for start, after in zip(starts, [*starts[1:], len(lines)], strict=True):
        end = start + 1
        while lines[end - 1].endswith("\\"):
            end += 1
        command = "\n".join([lines[start][2:], *lines[start + 1 : end]])
        yield Step(block, block.line + start, command, tuple(lines[end:after]))
