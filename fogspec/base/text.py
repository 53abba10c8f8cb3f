"""Text from files as text: one gate for each language that it is shown or written in.

A name in a checkout may hold terminal escapes, Markdown, markup or a change of reading direction. Each gate leaves plain text
as it is, and shows what cannot be seen as an escape: `\\x1b`, `\\u202e`.
"""

import re
import shlex
from collections.abc import Iterable
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
