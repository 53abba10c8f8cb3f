"""Text from files as text: one gate for each language that it is shown or written in.

A name in a checkout may hold terminal escapes, Markdown, markup or a change of reading direction. Each gate leaves plain text
as it is, and shows what cannot be seen as an escape: `\\x1b`, `\\u202e`.
"""

import itertools
import re
import shlex
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

# What a terminal obeys or a reader cannot see: controls, zero-width and direction marks, tags, separators, and surrogates.
HIDDEN = (
    "\x00-\x08\x0b-\x1f\x7f-\x9f\u00ad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\u3164"
    "\ud800-\udfff\ufdd0-\ufdef\ufeff\uffa0\ufff0-\ufffb\ufffe\uffff\U000e0000-\U000e0fff"
    + "".join(f"{chr(plane + 0xFFFE)}{chr(plane + 0xFFFF)}" for plane in range(0x10000, 0x110000, 0x10000))
)
INVISIBLE = re.compile(f"[{HIDDEN}]")
NOT_ON_A_LINE = re.compile(f"[\t\n{HIDDEN}]")
MARKUP = re.compile(r"[\\`*_\[\]<>|~&]|^[#+=-](?=[#+=\s-]|$)|(?<=^\d)[.)]|(?<=^\d\d)[.)]")
MATHEMATICS = re.compile(r"\$(?!\d)")
# GitHub links addresses, mentions and numbers of issues in plain text, also escaped ones: a zero-width space between ends it.
LINKED = re.compile(r":(?=//)|(?<!\w)@(?=\w)|@(?=[\w-]+\.)|#(?=\d)|(?<=\bwww)\.|(?<=\bGH)-(?=\d)", re.IGNORECASE)
SHORTEST = 16  # characters that are left of a name in a table, at least
NAMED = {"\n": "\\n", "\t": "\\t", "\r": "\\r"}


def escape(character: str) -> str:
    """Return how a character is written that cannot be seen."""
    code = ord(character)
    return NAMED.get(character) or (
        f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
    )


def visible(text: str) -> str:
    """Return the text without what a terminal obeys or a reader cannot see; lines and tabs stay."""
    return INVISIBLE.sub(lambda found: escape(found[0]), text)


def line(value: Any) -> str:
    """Return a value as visible text on one line."""
    return NOT_ON_A_LINE.sub(lambda found: escape(found[0]), str(value))


def paragraph(lines: Iterable[str]) -> str:
    """Return lines as text, of which none can become two."""
    return "\n".join(map(line, lines))


def count(number: int, noun: str) -> str:
    """Return `1 machine`, `2 machines`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def markdown(value: Any) -> str:
    """Return a value as one line of Markdown's text, also in a table or a heading: no markup, no link, no mention."""
    text = MARKUP.sub(lambda found: f"\\{found[0]}", line(value).strip())
    return LINKED.sub(lambda found: f"{found[0]}&#8203;", MATHEMATICS.sub("&#36;", text))


def code(value: Any) -> str:
    """Return a value as a code span of Markdown, or as its text where a table could not have the span."""
    text = line(value).strip()
    if not text or "|" in text:
        return markdown(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    pad = " " if "`" in (text[0], text[-1]) else ""
    return f"{fence}{pad}{text}{pad}{fence}"


def xml(value: Any) -> str:
    """Return a value as text of XML or HTML, also within quotes; what XML 1.0 forbids is shown as an escape."""
    text = visible(str(value)).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return text.replace('"', "&#34;").replace("'", "&#39;")


def json_text(text: str) -> str:
    """Return JSON that was written with all its characters, those that cannot be seen as JSON's escapes."""
    return INVISIBLE.sub(lambda found: _json_escape(ord(found[0])), text)


def shell(word: Any) -> str:
    """Return a word of a shell command: bash and zsh read it as exactly this word."""
    text = str(word)
    if not NOT_ON_A_LINE.search(text):
        return shlex.quote(text)
    return f"$'{''.join(map(_in_ansi_quotes, text))}'"


def shell_command(*words: Any) -> str:
    """Return a shell command of these words."""
    return " ".join(map(shell, words))


def restore_command(path: object) -> str:
    """Return the command that puts back what is committed, also of a file that a merge left in conflict."""
    return shell_command("git", "checkout", "HEAD", "--", path)


def _in_ansi_quotes(character: str) -> str:
    if character in "\\'":
        return f"\\{character}"
    if character in NAMED:
        return NAMED[character]
    if not NOT_ON_A_LINE.match(character):
        return character
    return "".join(f"\\x{byte:02x}" for byte in character.encode("utf-8", "surrogateescape"))


def _json_escape(code: int) -> str:
    if code < 0x10000:
        return f"\\u{code:04x}"
    return f"\\u{0xD800 + (code - 0x10000 >> 10):04x}\\u{0xDC00 + (code & 0x3FF):04x}"


def table(rows: Sequence[Sequence[str]], width: int, indent: int = 2) -> list[str]:
    """Return the lines of a table whose first row has the headings, at most `width` wide.

    Where it would be wider, headings are broken at blanks first, then cells, then words above `SHORTEST` characters are
    shortened in their middle, no further than to where two of them would read the same; no-break spaces become blanks.
    """
    columns = list(zip(*rows, strict=True))
    wide = [max(map(len, column)) for column in columns]
    words = [max((len(word) for cell in column for word in cell.split(" ")), default=0) for column in columns]
    bodies = [
        max(word, *map(len, column[1:])) if column[1:] else word for word, column in zip(words, columns, strict=True)
    ]
    room = width - indent - 2 * (len(columns) - 1)
    names = [
        max(min(word, SHORTEST), *(len(one) for cell in column for one in cell.split(" ") if "\u00a0" in one), 0)
        for word, column in zip(words, columns, strict=True)
    ]
    for least in (bodies, words, names):
        while sum(wide) > room and any(map(int.__gt__, wide, least)):
            at = max((n for n in range(len(wide)) if wide[n] > least[n]), key=lambda n: wide[n])
            wide[at] -= 1
    for n, column in enumerate(columns):
        while len({_with_short_words(cell, wide[n]) for cell in column}) < len(set(column)):
            wide[n] += 1
    lines = []
    for row in rows:
        cells = [
            textwrap.wrap(_with_short_words(cell, size), max(size, 1), break_long_words=False, break_on_hyphens=False)
            or [""]
            for cell, size in zip(row, wide, strict=True)
        ]
        for parts in itertools.zip_longest(*cells, fillvalue=""):
            text = "  ".join(part.ljust(size) for part, size in zip(parts, wide, strict=True))
            lines.append((" " * indent + text).replace("\u00a0", " ").rstrip())
    return lines


def _with_short_words(cell: str, most: int) -> str:
    """Return a text without a word of more than so many characters; names differ at both ends."""
    return " ".join(
        word if len(word) <= most else f"{word[: most // 2]}…{word[len(word) - (most - 1) // 2 :]}"
        for word in cell.split(" ")
    )


def blocks(rows: Sequence[Sequence[str]], width: int, keys: int = 1) -> list[str]:
    """Return the lines of a table of figures, at most `width` wide: in several blocks if need be, each with the first columns.

    The first row has the headings; the first `keys` columns are aligned to the left, the others to the right.
    """
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lead = sum(wide[:keys]) + 2 * (keys - 1)
    parts: list[list[int]] = [[]]
    for n in range(keys, len(wide)):
        if parts[-1] and lead + sum(wide[i] + 2 for i in (*parts[-1], n)) > width:
            parts.append([])
        parts[-1].append(n)
    lines: list[str] = []
    for part in parts:
        lines += [""] if lines else []
        for row in rows:
            names = [row[n].ljust(wide[n]) for n in range(keys)]
            lines.append("  ".join([*names, *(row[n].rjust(wide[n]) for n in part)]).rstrip())
    return lines
