"""Check the words of README, docs, help and messages against the style guide: `python -m tests.tools.terms`.

`docs/style.md` has the terms to write. Code spans and blocks of pages are what commands print: that is checked at its source.
Pages are README, CONTRIBUTING, CHANGELOG, docs and its decisions; code is all of `fogspec`, the agent too, and of the lab.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BANNED = {  # letters of either case, but for `(?-i:...)`
    r"nobody|somebody|everybody|anybody|anyone|no one\b|whoever": "name the actor",
    r"\btold\b": "reported, printed, shown",
    r"made again": "regenerated",
    r"\b(a|the|each) wave\b|\bwaves\b": "batch",
    r"\$?\d an hour|price (of )?an hour|prices an hour": "per hour",
    r"foretold|foretells?": "predicted",
    r"\banew": "again, recomputed",
    r"\bgoes on\b(?! top)": "continues, resumes",
    r"asked for\b": "requested, required",
    r"weighed sum": "objective value",
    r"dearer": "more expensive",
    r"for want of": "for lack of",
    r"cannot be had|can be had": "unavailable",
    r"whole numbers?\b": "integer",
    r"found twice": "duplicate",
    r"left-out (sample|machine)": "leave-one-out error",
    r"rules? out\b(?! of)": "excludes",
    r"of the language": "of the spec",
    r"(?<!there )(?<!when )\bis no (?!longer\b|such\b|more\b|doubt\b|problem\b|reason\b|exception\b|end\b|one\b)": "is not a",
    r"\b1 (machines|samples|requests|files|applications) ": "1 machine",
    r"\$\d+\.\d{6,}": "three significant digits",
    r"\d %(?![\w(%])": "90%, without a space",
    r"\binf times\b": "what the limit is",
    r"\b(machine|server|VM) types?\b": "instance type",
    r"(?<=\d )(?-i:vcpus?|VCPUs?|cpus)\b": "vCPUs",
}
# A quantity in a sentence has a space before its unit; without one it is a field's value, and stands in a code span.
GLUED = re.compile(r"(?<![\w.$/:=*-])\d[\d.,]*(ms|us|µs|s|min|h|d|[kKMGT]i?B)\b(?!/)")
PATTERN = re.compile("|".join(f"(?P<p{number}>{one})" for number, one in enumerate(BANNED)), re.IGNORECASE)
FENCE = re.compile(r"^( *)```.*?^\1```", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`[^`\n]*`")
NOT_OURS = ("the-paper.md", "codes.md", "fields.md", "verbs.md")  # generated: their source is checked


def main() -> int:
    """Print each banned word with its place and what to write; return 1 if there is one."""
    found = [*_pages(), *_code()]
    for path, line, word, better in found:
        print(f"{path}:{line}: {word!r}: write {better} (docs/style.md)")
    print(f"{len(found)} banned words")
    return 1 if found else 0


def _pages() -> Iterator[tuple[Path, int, str, str]]:
    pages = [path for path in (ROOT / "docs").rglob("*.md") if path.name not in NOT_OURS]
    for path in [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *sorted(pages)]:
        text = path.read_text("utf-8")
        for pattern in (FENCE, SPAN):
            text = pattern.sub(lambda part: re.sub(r"[^\n]", " ", part[0]), text)
        yield from ((path.relative_to(ROOT), *one) for one in _banned(text))
        for one in GLUED.finditer(text):
            yield (
                path.relative_to(ROOT),
                text.count("\n", 0, one.start()) + 1,
                one[0],
                "a space before the unit, or `code`",
            )


def _code() -> Iterator[tuple[Path, int, str, str]]:
    codes = ROOT / "fogspec" / "language" / "codes.toml"
    yield from ((codes.relative_to(ROOT), *one) for one in _banned(codes.read_text("utf-8")))
    for path in sorted(path for package in ("fogspec", "lab/fogspec_lab") for path in (ROOT / package).rglob("*.py")):
        for start, text in _strings(ast.parse(path.read_text("utf-8"))):
            yield from (
                (path.relative_to(ROOT), start + line - 1, word, better) for line, word, better in _banned(text)
            )


def _strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the strings of code with their lines; in an f-string each value is a 0."""
    parts = set[int]()
    for node in ast.walk(tree):  # breadth first: an f-string comes before its parts
        if isinstance(node, ast.JoinedStr):
            texts = [part.value if isinstance(part, ast.Constant) else "0" for part in node.values]
            parts |= {id(part) for part in node.values}
            yield node.lineno, "".join(map(str, texts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.lineno, node.value


def _banned(text: str) -> Iterator[tuple[int, str, str]]:
    better = list(BANNED.values())
    for one in PATTERN.finditer(text):
        yield text.count("\n", 0, one.start()) + 1, one[0], better[int(str(one.lastgroup)[1:])]


if __name__ == "__main__":
    sys.exit(main())
