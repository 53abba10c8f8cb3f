"""Measure, shorten and wrap the text of charts, which SVG itself cannot do.

Widths are those of DejaVu Sans, the widest font in the style's list: a text that fits in it fits in the others.
"""

import unicodedata

WIDTHS_EM = {
    0.30: "'ijlIJ",
    0.34: " ,./:;\\|·",
    0.42: "!()-[]frt",
    0.53: '"?sz^_`',
    0.60: "ckvxyLF",
    0.70: "ABCKRVXZ",
    0.79: "DGHNOQU&",
    0.87: "#+<=>~Mw×−≥→↑",
    1.00: "%mW@…",
}
EM = {character: width for width, characters in WIDTHS_EM.items() for character in characters}
USUAL, WIDE, BOLD = 0.65, 1.05, 1.15
SIZE, LABEL, LEAD, HEAD = (
    12.5,
    14.0,
    14.0,
    18.0,
)  # px: of most text, names at marks, the line below the title, the title


def width(text: str, size: float = SIZE, *, bold: bool = False) -> float:
    """Return an upper estimate of the width of a text at this font size, in px."""
    return sum(map(_em, text)) * size * (BOLD if bold else 1)


def shortened(text: str, room: float, size: float = SIZE, *, bold: bool = False) -> str:
    """Return the text, with an ellipsis in its middle if it is wider than `room` px: names differ at both ends."""
    if width(text, size, bold=bold) <= room:
        return text
    kept = len(text)
    while kept > 2:
        kept -= 1
        left = (2 * kept + 2) // 3
        cut = f"{text[:left]}…{text[len(text) - (kept - left) :]}"
        if width(cut, size, bold=bold) <= room:
            return cut
    return "…"


def wrapped(text: str, room: float, size: float = SIZE, *, bold: bool = False, most: int = 9) -> list[str]:
    """Return the text in lines at most `room` px wide, at most `most` of them, the last with an ellipsis if text is left."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and width(longer, size, bold=bold) <= room:
            lines[-1] = longer
        else:
            lines.append(shortened(word, room, size, bold=bold))
    if len(lines) > most:
        end = lines[most - 1]
        while end and width(end + "…", size, bold=bold) > room:
            end = end[:-1]
        lines = [*lines[: most - 1], end + "…"]
    return lines


def _em(character: str) -> float:
    if character in EM:
        return EM[character]
    if character.isascii():
        return USUAL
    return 0.0 if unicodedata.combining(character) else WIDE
