"""Draw dots on logarithmic axes as SVG: one frame for every chart, without scripts.

Attributes carry the light colors, and a media query swaps them by value on a dark page: a renderer that knows no style sheets
draws the light picture. Equal arguments give equal bytes.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from fogspec.base.text import xml
from fogspec.charts.names import Box, Rows, Taken, rows, through
from fogspec.charts.text import HEAD, LARGE, SIZE, shortened, width, wrapped

Point = tuple[float, float]

WIDE, HIGH = 720, 300  # px: of a picture, of a frame
MARGIN, LEFT, ROW = 16, 66, 18
HUES = {
    "ink": ("#123", "#eef"), "soft": ("#567", "#abc"), "grid": ("#dde", "#233"),
    "page": ("#fff", "#112"), "feasible": ("#def", "#124"), "chosen": ("#05b", "#7bf"),
    "misses": ("#789", "#89a"), "broken": ("#b22", "#f88"), "gpu-1": ("#a40", "#fa6"),
    "gpu-2": ("#076", "#4cb"), "gpu-3": ("#73b", "#caf"),
}  # fmt: skip
LIGHT = {name: light for name, (light, _) in HUES.items()} | {"meets": HUES["ink"][0]}
FONT = "system-ui,'DejaVu Sans',sans-serif"
# Of each kind of line its hue, dashes, and words; and the width of the interval of a hue.
LINES = {
    "curve": ("ink", "", "geometric mean"),
    "iso": ("chosen", "3 4", "as good as the choice"),
    "paper": ("soft", "2 4", ""),
}
THICK = {"misses": 1, "chosen": 2.2}
BOLD = ' font-weight="600"'
STRONG = ("chosen", "broken")  # hues of large dots
STEPS = ((1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1, 3), (1,))  # of ticks in a decade
SPAN = 0.32  # decades at least, about a factor of two, so that one machine alone has ticks around it
SPECKS, GRAINS = 160, (4, 8, 16, 24)  # dots without a mark of their own, and px between them


@dataclass(frozen=True, slots=True, kw_only=True)
class Dot:
    """A dot with what a pointer reads there, its interval between two points, and the name beside it, if any.

    `hue` is a key of `HUES`, or `meets` for ink. What was measured is filled.
    """

    title: str
    x: float
    y: float
    ends: tuple[Point, Point] | None = None
    measured: bool = False
    diamond: bool = False
    hue: str = "meets"
    name: str = ""


@dataclass(frozen=True, slots=True)
class Limit:
    """a·log10 x + b·log10 y is at most `most`; `words` stand beside the line."""

    words: str
    a: float
    b: float
    most: float


@dataclass(frozen=True, slots=True)
class Axis:
    """A logarithmic axis between two logarithms to the base 10; without `values`, round ones have ticks."""

    label: str
    words: Callable[[float], str]
    low: float
    high: float
    values: Sequence[float] = ()

    @classmethod
    def over(
        cls, label: str, words: Callable[[float], str], shown: Iterable[float], values: Sequence[float] = ()
    ) -> "Axis":
        """Return an axis that shows positive values with a margin; a single one is in the middle."""
        logs = [log(value) for value in shown]
        low, high = min(logs), max(logs)
        pad = max(0.07 * (high - low), (SPAN - (high - low)) / 2)
        return cls(f"{label} (log scale)", words, low - pad, high + pad, values)

    def shows(self, value: float) -> bool:
        """Return whether a value is between the ends."""
        return self.low <= log(value) <= self.high

    def ticks(self, long: float, room: Callable[[str], float]) -> list[tuple[float, str]]:
        """Return the logarithms and texts of ticks, as many as fit on `long` px, of which a text takes `room`."""
        scale, found = long / (self.high - self.low), list[tuple[float, str]]()
        decades = range(max(math.floor(self.low), -300), min(math.ceil(self.high), 300) + 1)
        for values in [self.values] if self.values else [[m * 10.0**d for d in decades for m in s] for s in STEPS]:
            inside = [value for value in values if self.shows(value)]
            found = []
            for value in sorted(inside, key=lambda v: (bool(self.values) and not math.log2(v).is_integer(), v)):
                at, text = log(value), self.words(value)
                if all(abs(at - other) * scale >= (room(text) + room(words)) / 2 for other, words in found):
                    found.append((at, text))
            if len(found) == len(inside):
                break
        return sorted(found)


@dataclass(slots=True, kw_only=True)
class Frame:
    """One coordinate system; `lines` are (kind, points), `specks` are (hue, x, y) of dots without a mark of their own.

    A line is a key of `LINES`, with a hue after a space. `remark` says what the axes leave out.
    """

    x: Axis
    y: Axis
    dots: Sequence[Dot] = ()
    limits: Sequence[Limit] = ()
    lines: Sequence[tuple[str, Sequence[Point]]] = ()
    specks: Sequence[tuple[str, Rows, Rows]] = ()
    heading: str = ""
    remark: str = ""

    @property
    def inside(self) -> list[Dot]:
        """The dots that the axes show, the less important ones first."""
        dots = [dot for dot in self.dots if self.x.shows(dot.x) and self.y.shows(dot.y)]
        return sorted(dots, key=lambda d: (d.hue in STRONG, d.hue != "misses", d.hue, d.measured, d.y, d.title))

    @property
    def corners(self) -> list[Point]:
        """The corners as logarithms."""
        x, y = self.x, self.y
        return [(x.low, y.low), (x.high, y.low), (x.high, y.high), (x.low, y.high)]

    def edge(self, one: Limit) -> list[Point]:
        """Return the ends of a limit's line as logarithms; none outside."""
        on = [(p, q) for p, q in below(self.corners, one) if abs(one.a * p + one.b * q - one.most) < 1e-9]
        return on if len(on) == 2 else []

    def above(self, wide: float) -> list[str]:
        """Return the remark as lines above the frame; none if it has room beside the axis' label."""
        beside = width(f"↑ {self.y.label}") + width(self.remark) + 3 * SIZE <= wide
        return [] if beside else wrapped(self.remark, wide)


def log(value: float) -> float:
    """Return the logarithm to the base 10 of six digits of a value: more would differ between processors."""
    return math.log10(min(max(float(f"{value:.6g}"), 1e-300), 1e300))


def below(polygon: Sequence[Point], one: Limit) -> list[Point]:
    """Return the part of a polygon that a limit leaves (Sutherland and Hodgman, Commun. ACM 17 (1974) 32)."""
    found: list[Point] = []
    for (p, q), (r, s) in zip(polygon, [*polygon[1:], *polygon[:1]], strict=True):
        here, there = one.a * p + one.b * q - one.most, one.a * r + one.b * s - one.most
        if here <= 0:
            found.append((p, q))
        if (here > 0) != (there > 0):
            found.append((p + here / (here - there) * (r - p), q + here / (here - there) * (s - q)))
    return found


def path(points: Iterable[Point]) -> str:
    """Return an SVG path through points in px."""
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in points)


def segments(lines: Iterable[Box]) -> str:
    """Return an SVG path of segments in px."""

    def end(x: float, y: float, x2: float, y2: float) -> str:
        return f"V{y2:g}" if x2 == x else f"H{x2:g}" if y2 == y else f"L{x2:g} {y2:g}"

    return "".join(f"M{x:g} {y:g}{end(x, y, x2, y2)}" for x, y, x2, y2 in lines)


def text(x: float, y: float, words: str, more: str = "") -> str:
    """Return a text that begins at x in px, with `more` attributes after a space."""
    return f'<text x="{x:g}" y="{y:g}"{more}>{xml(words)}</text>'


def fill(hue: str) -> str:
    """Return the attribute of a hue after a space; none of ink, in which the page is written."""
    return "" if LIGHT[hue] == LIGHT["ink"] else f' fill="{LIGHT[hue]}"'


def stroke(hue: str, px: float) -> str:
    """Return the attributes of a line of so many px after a space."""
    return f' stroke="{LIGHT[hue]}" stroke-width="{px:g}"'


def mark(x: float, y: float, r: float, diamond: bool, inner: str = "", more: str = "") -> str:
    """Return the element of a dot of radius r in px."""
    d = round(1.25 * r, 1)
    turned = f"M{x:g} {round(y - d, 1):g}l{d:g} {d:g}l-{d:g} {d:g}l-{d:g}-{d:g}z"
    tag, form = ("path", f'd="{turned}"') if diamond else ("circle", f'cx="{x:g}" cy="{y:g}" r="{r:g}"')
    return f"<{tag} {form}{more}" + (f">{inner}</{tag}>" if inner else "/>")


def line_paint(kind: str) -> str:
    """Return the attributes of a kind of line after a space; its hue follows a space if it is not the kind's own."""
    name, _, own = kind.partition(" ")
    hue, dashes, _ = LINES[name]
    return stroke(own or hue, 1.5) + (f' stroke-dasharray="{dashes}"' if dashes else "")


class Drawing:
    """The elements of one frame in a box in px."""

    def __init__(self, frame: Frame, box: Box) -> None:
        self.frame, self.box, self.taken = frame, box, Taken(box)
        left, top, right, bottom = box
        clip, size = f"in-{left:g}-{top:g}", f'width="{right - left:g}" height="{bottom - top:g}"'
        ends = [(limit.words, frame.edge(limit)) for limit in frame.limits]
        self.limits = [(words, (*self._at(*of[0]), *self._at(*of[1]))) for words, of in ends if of]
        self.dots = [(dot, *self._px((dot.x, dot.y)), 7.0 if dot.hue in STRONG else 4.6) for dot in frame.inside]
        self.parts = [
            *self._around(),
            f'<clipPath id="{clip}"><rect x="{left:g}" y="{top:g}" {size}/></clipPath>',
            f'<g clip-path="url(#{clip})" fill="none">',
            *self._lines(),
            *self._specks(),
            *(f'<path class="limit" d="{segments([one])}"{stroke("ink", 1.6)}/>' for _, one in self.limits),
            *self._intervals(),
            "</g>",
            *self._marks(),
            *self._names(),
        ]

    def _at(self, x: float, y: float) -> Point:
        """Return the place of logarithms in px, whole ones: less is not seen."""
        (left, top, right, bottom), fx, fy = self.box, self.frame.x, self.frame.y
        across, up = (x - fx.low) / (fx.high - fx.low), (y - fy.low) / (fy.high - fy.low)
        return round(left + across * (right - left)), round(bottom - up * (bottom - top))

    def _px(self, point: Point) -> Point:
        """Return the place of values in px."""
        return self._at(log(point[0]), log(point[1]))

    def _around(self) -> list[str]:
        """Return the area that the limits leave, the grid, and the words around the frame."""
        frame, (left, top, right, bottom) = self.frame, self.box
        area, above = frame.corners, frame.above(right - left)
        for limit in frame.limits:
            area = below(area, limit)
        ticks = frame.x.ticks(right - left, lambda words: width(words) + 14)
        xs = [(x, words) for one, words in ticks if (x := self._at(one, 0)[0]) + width(words) / 2 <= right + MARGIN]
        ys = [(self._at(0, one)[1], words) for one, words in frame.y.ticks(bottom - top, lambda _: 20.0)]
        grid = "".join([*(f"M{left:g} {y:g}H{right:g}" for y, _ in ys), *(f"M{x:g} {top:g}V{bottom:g}" for x, _ in xs)])
        starts = [text(left, top - 11 - ROW * n, words) for n, words in enumerate([f"↑ {frame.y.label}", *above[::-1]])]
        ends = [(right, bottom + 37, f"{frame.x.label} →"), *((left - 8, y + 4, words) for y, words in ys)]
        ends += [(right, top - 11, frame.remark)] * bool(frame.remark and not above)
        heading = text(left, top - 29 - ROW * len(above), frame.heading, BOLD)
        return [
            *[f'<path d="{path(self._at(*p) for p in area)}Z"{fill("feasible")}/>']
            * bool(frame.limits and len(area) > 2),
            *[heading] * bool(frame.heading),
            f'<path d="{grid}"{stroke("grid", 1)}/>',
            f"<g{fill('soft')}>{''.join(starts)}",
            f'<g text-anchor="end">{"".join(text(*one) for one in ends)}</g>',
            f'<g text-anchor="middle">{"".join(text(x, bottom + 18, words) for x, words in xs)}</g></g>',
        ]

    def _lines(self) -> list[str]:
        """Return the lines, of each the part inside of the frame."""
        found = []
        for kind, points in self.frame.lines:
            places = [self._px(one) for one in points]
            steps = [(*a, *b) for a, b in pairwise(places)]
            seen = through(rows([self.box]), rows(steps))[0]
            self.taken.soft += [step for step, one in zip(steps, seen, strict=True) if one]
            kept = np.append(seen, False) | np.append(False, seen)
            d = path(place for place, one in zip(places, kept, strict=True) if one)
            found += [f'<path d="{d}"{line_paint(kind)}/>'] * bool(seen.any())
        return found

    def _specks(self) -> list[str]:
        """Return the dots without marks: those in one place are one, and places are further apart if they are many."""
        found, (left, top, right, bottom) = [], self.box
        for hue, xs, ys in self.frame.specks:
            places = [self._px(one) for one in zip(xs.tolist(), ys.tolist(), strict=True)]
            inside = [(x, y) for x, y in places if left <= x <= right and top <= y <= bottom]
            for grain in GRAINS:
                cells = sorted({(round(x / grain), round(y / grain)) for x, y in inside})
                if len(cells) <= SPECKS * (right - left) / WIDE:
                    break
            self.taken.soft += [(grain * x - 2, grain * y - 2, grain * x + 2, grain * y + 2) for x, y in cells]
            # The sign separates two numbers, and a closed path without length is a dot of the line's width.
            steps = [f"m{x - x0}{y - y0:+}z" for (x0, y0), (x, y) in pairwise([(0, 0), *cells])]
            paint = f'{stroke(hue, 3.5 / grain)} stroke-linecap="round" transform="scale({grain})"'
            found += [f'<path d="{"".join(steps)}"{paint}/>'] * bool(cells)
        return found

    def _intervals(self) -> list[str]:
        """Return the intervals, those of a hue as one path."""
        found = []
        for hue, group in groupby(self.frame.inside, key=lambda dot: dot.hue):
            bars = [(*self._px(dot.ends[0]), *self._px(dot.ends[1])) for dot in group if dot.ends]
            self.taken.lines += bars
            found += [f'<path d="{segments(bars)}"{stroke(hue, THICK.get(hue, 1.4))}/>'] * bool(bars)
        return found

    def _marks(self) -> list[str]:
        """Return the dots, neighbors of one paint as a group."""
        found = []
        for (hue, measured), group in groupby(self.dots, key=lambda one: (one[0].hue, one[0].measured)):
            forms = [mark(x, y, r, dot.diamond, f"<title>{xml(dot.title)}</title>") for dot, x, y, r in group]
            paint = f'stroke="{LIGHT[hue]}" fill="{LIGHT[hue if measured else "page"]}"'
            found.append(f'<g class="mark" {paint}>{"".join(forms)}</g>')
        return found

    def _names(self) -> list[str]:
        """Return the words of the limits and the names of dots, with leader lines, where they have room."""
        taken, words, leaders, names = self.taken, list[str](), list[Box](), list[str]()
        reaches = [(x, y, r * (1.25 if dot.diamond else 1) + 1) for dot, x, y, r in self.dots]
        taken.dots = [(x - r, y - r, x + r, y + r) for x, y, r in reaches]
        taken.lines += [line for _, line in self.limits]
        for said, line in self.limits:
            if place := taken.beside(line, width(said) + 4, SIZE + 4):
                words.append(self._write(place, said))
        for (dot, *_), own in list(zip(self.dots, taken.dots, strict=True))[::-1]:
            said = shortened(dot.name, 190, LARGE, bold=True)
            if said and (found := taken.near(own, width(said, LARGE, bold=True) + 3, LARGE + 5)):
                names.append(self._write(found[0], said, fill("soft" if dot.hue == "misses" else dot.hue)))
                leaders += [found[1]] if found[1] else []
                taken.lines += leaders
        words += [f'<path class="leader" d="{segments(leaders)}"{stroke("soft", 1)}/>'] * bool(leaders)
        return [*words, *[f'<g font-size="{LARGE}"{BOLD}>{"".join(names)}</g>'] * bool(names)]

    def _write(self, box: Box, words: str, more: str = "") -> str:
        """Return words in a box, which other words then must not touch."""
        self.taken.names.append(box)
        return text(round(box[0] + 1.5, 1), round(box[3] - 5, 1), words, more)


def legend(frames: Sequence[Frame]) -> list[tuple[str, str]]:
    """Return what frames show as (kind, words)."""
    dots = [dot for frame in frames for dot in frame.inside]
    specks = [hue for frame in frames for hue, *_ in frame.specks]
    lines = {kind.partition(" ")[0] for frame in frames for kind, _ in frame.lines}
    slants = sorted({"bar" if dot.ends[0][0] < dot.ends[1][0] else "upright" for dot in dots if dot.ends})
    return [
        *[("measured", "measured")] * any(dot.measured for dot in dots),
        *[("predicted", "predicted")] * bool(specks or not all(dot.measured for dot in dots)),
        *[("diamond", "with GPU")] * any(dot.diamond for dot in dots),
        *[("misses", "misses a limit")] * ("misses" in [*specks, *(dot.hue for dot in dots)]),
        *((kind, "90% interval") for kind in slants[:1]),
        *((kind, LINES[kind][2]) for kind in sorted(lines)),
    ]


def sign(kind: str, x: float, y: float) -> str:
    """Return the sign of a kind in the legend."""
    if kind in LINES:
        return f'<path d="M{x:g} {y - 4:g}h24"{line_paint(kind)}/>'
    if kind in ("bar", "upright"):
        d = f"M{x + 1:g} {y + 2:g}l10-12" if kind == "bar" else f"M{x + 5:g} {y + 2:g}v-13"
        return f'<path d="{d}"{stroke("ink", 1.4)}/>'
    hue = LIGHT.get(kind, LIGHT["ink"])
    paint = f' stroke="{hue}" fill="{LIGHT["page"] if kind == "predicted" else hue}"'
    return mark(x + 5, y - 4, 4.4, kind == "diamond" or kind.startswith("gpu"), more=paint)


def picture(
    title: str,
    frames: Sequence[Frame],
    *,
    lead: Sequence[tuple[str, bool]] = (),
    facts: str = "",
    table: Sequence[tuple[str, str]] = (),
    keys: Sequence[tuple[str, str]] | None = None,
    source: str = "",
    notes: Sequence[str] = (),
    columns: int = 1,
    high: int = HIGH,
    hue: str = "ink",
) -> str:
    """Return a picture: title, lead, facts, a table of heads and texts, frames in columns, legend, source and warnings.

    Words of the lead are bold if they say so. Without `keys`, as (kind, words), the legend is that of what the frames show.
    Screen readers read its texts. Frames are `high` px; `hue` is the title's.
    """
    body, room, y = list[str](), WIDE - 2 * MARGIN, 28
    for words in wrapped(title, room, HEAD, bold=True):
        body.append(text(MARGIN, y, words, f' font-size="{HEAD}"{BOLD}{fill(hue)}'))
        y += 22
    if lead:
        parts = [f"<tspan{BOLD}>{xml(one)}</tspan>" if bold else xml(one) for one, bold in lead]
        body.append(f'<text x="{MARGIN}" y="{y}" font-size="{LARGE}">{"".join(parts)}</text>')
        y += 20
    for words in wrapped(facts, room):
        body.append(text(MARGIN, y, words, fill("soft")))
        y += ROW
    tab = round(10 + max((width(head, bold=True) for head, _ in table), default=0))
    y += 5 * bool(table)
    for head, said in table:
        body.append(text(MARGIN, y, head, BOLD))
        for words in wrapped(said, room - tab, most=2):
            body.append(text(MARGIN + tab, y, words))
            y += ROW
    for at, frame in enumerate(frames):
        left, right = (WIDE * (at % columns + n) / columns + by for n, by in ((0, LEFT), (1, -MARGIN)))
        if at % columns == 0:
            y += 16 + (30 if frame.heading else 8) + ROW * len(frame.above(right - left))
        body += Drawing(frame, (left, y, right, y + high)).parts
        y += (high + 42) * (at % columns == columns - 1 or frame is frames[-1])
    x, y = MARGIN, y + 18
    body.append(f"<g{fill('soft')}>")
    for kind, words in legend(frames) if keys is None else keys:
        wide = 30 if kind in LINES else 16
        if x > MARGIN and x + wide + width(words) > WIDE - MARGIN:
            x, y = MARGIN, y + 22
        body += [sign(kind, x, y), text(x + wide, y, words)]
        x += round(wide + width(words) + 14)
    if source:
        y += 22
        body.append(text(MARGIN, y, source))
    body.append("</g>")
    for words in [one for note in notes for one in wrapped(f"⚠ {note}", room)]:
        y += ROW
        body.append(text(MARGIN, y, words))
    return _document(title, body, y + MARGIN)


def _document(title: str, body: Sequence[str], high: int) -> str:
    """Return the document with its page, and the colors of a dark one: a group of texts with a name."""
    size, ink = f'width="{WIDE}" height="{high}"', f'fill="{LIGHT["ink"]}"'
    drawn = "\n".join([f'<rect {size} fill="{LIGHT["page"]}"/>', *body])
    swaps = [(f'{one}="{light}"', f"{one}:{dark}") for light, dark in HUES.values() for one in ("fill", "stroke")]
    dark = "".join(f"[{light}]{{{dark}}}" for light, dark in swaps if light in drawn or light == ink)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE} {high}" {size} role="group" '
        f'font-family="{FONT}" font-size="{SIZE}" stroke-width="2" {ink}>\n'
        f"<title>{xml(title)}</title>\n"
        f"<style>text{{unicode-bidi:isolate}}@media(prefers-color-scheme:dark){{{dark}}}</style>\n{drawn}\n</svg>\n"
    )
