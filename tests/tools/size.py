"""What a person must learn and what is maintained, counted from the program itself: `python -m tests.tools.size`.

Lines and statements by room; commands, options and keys as a user meets them; decisions, words, tests, and the minutes of the
groups that last ran here.
"""

import ast
import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import click

from fogspec.cli import VERBS, fogspec

ROOT = Path(__file__).resolve().parents[2]
SIDE = {"templates": (".j2", ".css"), "JavaScript": (".js",), "C": (".c", ".h")}


def _python(folder: Path) -> tuple[int, int, int]:
    """Return files, lines and statements of the Python below `folder`."""
    texts = [path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.py"))]
    statements = sum(isinstance(node, ast.stmt) for text in texts for node in ast.walk(ast.parse(text)))
    return len(texts), sum(text.count("\n") for text in texts), statements


def rooms(product: Path) -> dict[str, tuple[int, int, int]]:
    """Return files, lines and statements of each package in `product`, and of the modules beside them."""
    found = {
        path.name: _python(path) for path in sorted(product.iterdir()) if path.is_dir() and path.name != "__pycache__"
    }
    return {name: size for name, size in found.items() if size[0]}


def beside(root: Path) -> dict[str, int]:
    """Return the lines of what is shipped and is not Python, by kind."""
    files = [path for folder in ("templates", "fogspec") for path in (root / folder).rglob("*")]
    return {
        kind: sum(path.read_text(encoding="utf-8").count("\n") for path in files if path.suffix in ends)
        for kind, ends in SIDE.items()
    }


def _commands(command: click.Command) -> Iterator[click.Command]:
    if not isinstance(command, click.Group):
        yield command
        return
    for inner in command.commands.values():
        yield from _commands(inner)


def options() -> dict[str, int]:
    """Return how many options each command has, `--help` left out."""
    context = click.Context(fogspec)
    counts = {}
    for name in VERBS:
        command = fogspec.get_command(context, name)
        assert command is not None
        counts[name] = sum(isinstance(one, click.Option) for each in _commands(command) for one in each.params)
    return counts


def keys(schema: object) -> set[str]:
    """Return the names of all properties in a JSON Schema."""
    if isinstance(schema, list):
        return set().union(*map(keys, schema))
    if not isinstance(schema, Mapping):
        return set()
    own = schema.get("properties", {})
    nested = [*own.values(), *(value for name, value in schema.items() if name != "properties")]
    return set(own).union(*map(keys, nested))


def words(paths: list[Path]) -> int:
    """Return the number of words in text files."""
    return sum(len(path.read_text(encoding="utf-8").split()) for path in paths)


def main() -> None:
    """Print the whole table."""
    sizes = rooms(ROOT / "fogspec")
    print(f"{'room':<12}{'files':>7}{'lines':>8}{'statements':>12}")
    for name, (files, lines, statements) in sorted(sizes.items(), key=lambda item: -item[1][1]):
        print(f"{name:<12}{files:>7}{lines:>8}{statements:>12}")
    for name in ("fogspec", *(one for one in ("lab", "probe", "tests") if (ROOT / one).is_dir())):
        files, lines, statements = _python(ROOT / name)
        print(f"{name + '/':<12}{files:>7}{lines:>8}{statements:>12}")
    print("  ".join(f"{kind}: {lines}" for kind, lines in beside(ROOT).items()))
    counts = options()
    spec = keys(json.loads((ROOT / "schemas" / "Application.json").read_text(encoding="utf-8")))
    print(f"commands: {len(counts)}  options: {sum(counts.values())}  keys of a spec: {len(spec)}")
    adrs, pages = sorted((ROOT / "docs" / "adr").glob("[0-9]*.md")), sorted((ROOT / "docs").rglob("*.md"))
    texts = [ROOT / "README.md", ROOT / "CHANGELOG.md", *pages]
    print(f"ADRs: {len(adrs) - 1}  words of README, changelog and docs: {words(texts)}")
    tests = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "tests").rglob("test_*.py"))]
    print(f"test functions: {sum(text.count(chr(10) + 'def test_') for text in tests)}")
    for path in sorted((ROOT / "build" / "times").glob("*")):
        print(f"last run here: {path.read_text(encoding='utf-8').strip()}")


if __name__ == "__main__":
    main()
