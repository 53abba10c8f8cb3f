"""Seeded mutations of example specs: what people get wrong, and what disks do."""

import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

KEY = re.compile(r"^(\s*(?:- )?)([A-Za-z_]+):( |$)")
QUANTITY = re.compile(
    r"^(\s*(?:- )?[a-z_]+: )(\$?)([0-9.]+)(ns|us|ms|s|min|h|MiB|GiB|TiB|/request|/\d+ requests|)(\s+#.*)?$"
)
RANGE = re.compile(r"([0-9.]+(?:[GM]iB)?)\.\.([0-9.]+(?:[GM]iB)?)")
SCALAR = re.compile(r"^(\s*(?:- )?[A-Za-z_]+: )([^\[\]{}#|>&*]+?)(\s+#.*)?$")


@dataclass(frozen=True, slots=True)
class Mutant:
    """A spec with one mistake: `line` (from 1) is the line that was changed, `right` what a good fix names."""

    kind: str
    content: bytes
    line: int
    right: str | None = None


Change = Callable[[random.Random, list[str]], tuple[list[str], int, str | None] | None]


def mutants(text: str, count: int, seed: int) -> Iterator[Mutant]:
    """`count` mutants of a spec, the same for the same seed; each kind as often as any other."""
    rng = random.Random(seed)
    kinds = list(CHANGES)
    made = 0
    while made < count:
        kind = kinds[made % len(kinds)]
        changed = CHANGES[kind](rng, text.split("\n"))
        if changed is None:
            kinds.remove(kind)
            continue
        lines, index, right = changed
        made += 1
        yield Mutant(kind, "\n".join(lines).encode(), index + 1, right)
    rng.random()


def _keys(lines: list[str]) -> list[int]:
    return [i for i, line in enumerate(lines) if (match := KEY.match(line)) and match[2] not in ("model", "scenario")]


def _swap(rng: random.Random, word: str) -> str:
    """A typing mistake: a letter left out, doubled, swapped with its neighbour, or another one."""
    i = rng.randrange(len(word))
    how = rng.randrange(4)
    if how == 0 and len(word) > 3:
        return word[:i] + word[i + 1 :]
    if how == 1:
        return word[:i] + word[i] + word[i:]
    if how == 2 and i + 1 < len(word) and word[i] != word[i + 1]:
        return word[:i] + word[i + 1] + word[i] + word[i + 2 :]
    letter = rng.choice("abcdefghijklmnopqrstuvwxyz".replace(word[i].lower(), ""))
    return word[:i] + letter + word[i + 1 :]


def rename_key(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A key with a typing mistake."""
    i = rng.choice(_keys(lines))
    match = KEY.match(lines[i])
    assert match
    wrong = _swap(rng, match[2])
    lines[i] = f"{match[1]}{wrong}:{lines[i][match.end(2) + 1 :]}"
    return lines, i, match[2] if wrong != match[2] else None


def drop_unit(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A quantity without its unit."""
    found = [i for i, line in enumerate(lines) if (match := QUANTITY.match(line)) and (match[2] or match[4])]
    if not found:
        return None
    i = rng.choice(found)
    match = QUANTITY.match(lines[i])
    assert match
    lines[i] = match[1] + match[3] + (match[5] or "")
    return lines, i, f"{match[2]}{match[3].rstrip('0').rstrip('.') if '.' in match[3] else match[3]}"


def swap_range(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A range with its ends exchanged."""
    found = [i for i, line in enumerate(lines) if RANGE.search(line.partition("#")[0])]
    if not found:
        return None
    i = rng.choice(found)
    match = RANGE.search(lines[i])
    assert match
    lines[i] = lines[i][: match.start()] + f"{match[2]}..{match[1]}" + lines[i][match.end() :]
    return lines, i, f"{match[1]}..{match[2]}"


def retype(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A value of another kind."""
    found = [i for i, line in enumerate(lines) if SCALAR.match(line)]
    i = rng.choice(found)
    match = SCALAR.match(lines[i])
    assert match
    value = rng.choice(
        ["true", "[1, 2]", "{a: 1}", "-3", "''", "null", "hello world", "1e999", "0x1G", "no", ".nan", "010"]
    )
    lines[i] = match[1] + value + (match[3] or "")
    return lines, i, None


def drop_line(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A line that is missing; the line that is there now, or the one before, is the place."""
    i = rng.choice(_keys(lines))
    del lines[i]
    return lines, i, None


def reindent(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A line that is nested elsewhere."""
    i = rng.choice(_keys(lines))
    step = rng.choice([-2, -1, 1, 2, 4])
    stripped = lines[i].lstrip(" ")
    indent = len(lines[i]) - len(stripped) + step
    if indent < 0:
        indent += 2 - step
    lines[i] = " " * indent + stripped
    return lines, i, None


def repeat_line(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A line that is there twice; either of the two is the place."""
    i = rng.choice(_keys(lines))
    lines.insert(i, lines[i])
    return lines, i + 1, None


def cut(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """A file that ends too early; its last line is the place."""
    text = "\n".join(lines)
    at = rng.randrange(1, len(text))
    kept = text[:at].split("\n")
    last = max((i for i, line in enumerate(kept) if line.strip()), default=0)
    return kept, last, None


def damage(rng: random.Random, lines: list[str]) -> tuple[list[str], int, str | None] | None:
    """One character that became another."""
    found = [i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    i = rng.choice(found)
    at = rng.randrange(len(lines[i]))
    lines[i] = lines[i][:at] + rng.choice("\t\x00\x07:{}[]'\"#&*!|>%@`-?,\\~a9é\u202e") + lines[i][at + 1 :]
    return lines, i, None


CHANGES: dict[str, Change] = {
    "key renamed": rename_key,
    "unit dropped": drop_unit,
    "range swapped": swap_range,
    "value retyped": retype,
    "line dropped": drop_line,
    "nesting moved": reindent,
    "line repeated": repeat_line,
    "file cut": cut,
    "character damaged": damage,
}
