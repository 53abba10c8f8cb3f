"""Measure, shorten and wrap the text of charts, which SVG itself cannot do.

Widths are those of DejaVu Sans, the widest font in the list of fonts: a text that fits in it fits in the others.
"""

import unicodedata

from fogspec.base.units import shown, shown_duration

WIDTHS_EM = {
    0.30: "'ijlIJ", 0.34: " ,./:;\\|·", 0.42: "!()-[]frt", 0.53: '"?sz^_`', 0.60: "ckvxyLF", 0.70: "ABCKRVXZ",
    0.79: "DGHNOQU&", 0.87: "#+<=>~Mw×−≥→↑", 1.00: "%mW@…",
}  # fmt: skip
EM = {character: width for width, characters in WIDTHS_EM.items() for character in characters}
USUAL, WIDE, BOLD = 0.65, 1.05, 1.15
SIZE, LARGE, HEAD = 12.5, 14, 18  # px: of most text, of the line below the title and names at dots, of the title


def width(text: str, size: float = SIZE, *, bold: bool = False) -> float:
    """Return an upper estimate of the width of a text at this font size, in px."""
    em = (EM.get(c) or (USUAL if c.isascii() else 0.0 if unicodedata.combining(c) else WIDE) for c in text)
    return sum(em) * size * (BOLD if bold else 1)


def shortened(text: str, room: float, size: float = SIZE, *, bold: bool = False) -> str:
    """Return the text, with an ellipsis in its middle if it is wider than `room` px: names differ at both ends."""
    kept, cut = len(text), text
    while width(cut, size, bold=bold) > room and kept:
        kept -= 1
        left = (2 * kept + 2) // 3
        cut = f"{text[:left]}…{text[len(text) - (kept - left) :]}"
    return cut


def wrapped(text: str, room: float, size: float = SIZE, *, bold: bool = False, most: int = 3) -> list[str]:
    """Return the text in at most `most` lines of at most `room` px, the last with an ellipsis if text is left."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and width(longer, size, bold=bold) <= room:
            lines[-1] = longer
        else:
            lines.append(shortened(word, room, size, bold=bold))
    if len(lines) > most:
        end = lines[most - 1]
        while width(f"{end}…", size, bold=bold) > room:
            end = end[:-1]
        lines = [*lines[: most - 1], f"{end}…"]
    return lines


def seconds(value: float) -> str:
    """Return a duration with three significant digits, such as `12 ms` or `1,250 s`: the ticks of an axis share a unit."""
    return shown_duration(value) if value < 0.9995 else f"{shown(value)} s"
