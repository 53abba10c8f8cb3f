"""Lay out one coordinate system of a chart: axes, forbidden regions, and labels that do not overlap."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fogspec.charts.axes import CHARACTER, Axis, tall, wide

Point = tuple[float, float]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """A label next to a point, with a leader line if it was moved away."""

    x: float
    y: float
    anchor: str
    words: str
    kind: str
    leader: tuple[float, float, float, float] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Dot:
    """A machine: `kind` is its CSS class, `bar` the ends of its interval, `title` the text for screen readers."""

    x: float
    y: float
    kind: str
    radius: float
    title: str
    bar: tuple[float, float] | None = None


@dataclass(slots=True, kw_only=True)
class Frame:
    """One coordinate system as the template draws it; `specks`, `lines` and `areas` are (class, path) pairs."""

    x: Axis
    y: Axis
    x_label: str
    y_label: str
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]
    heading: str = ""
    remark: str = ""
    areas: list[tuple[str, str]] = field(default_factory=list)
    lines: list[tuple[str, str]] = field(default_factory=list)
    specks: list[tuple[str, str]] = field(default_factory=list)
    dots: list[Dot] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)

    @property
    def box(self) -> Box:
        """The left, top, right and bottom edges, in px."""
        return self.x.start, self.y.end, self.x.end, self.y.start

    def forbid(self, a: float, b: float, limit: float) -> None:
        """Shade where a·log10 x + b·log10 y is above the limit, and draw its edge."""
        corners = [
            (self.x.low, self.y.low),
            (self.x.high, self.y.low),
            (self.x.high, self.y.high),
            (self.x.low, self.y.high),
        ]
        inside = _clipped(corners, a, b, limit)
        if len(inside) < 3:
            return
        self.areas.append(("no", _path([(self.x.place(p), self.y.place(q)) for p, q in inside]) + "Z"))
        edge = [(p, q) for p, q in inside if abs(a * p + b * q - limit) < 1e-9]
        if len(edge) >= 2:
            self.lines.append(("limit", _path([(self.x.place(p), self.y.place(q)) for p, q in edge[:2]])))


def frame(
    x: Axis,
    y: Axis,
    x_label: str,
    y_label: str,
    x_words: Callable[[float], str],
    y_words: Callable[[float], str],
    heading: str = "",
) -> Frame:
    """Return an empty coordinate system with its ticks."""
    return Frame(
        x=x,
        y=y,
        x_label=x_label,
        y_label=y_label,
        x_ticks=x.ticks(x_words, wide),
        y_ticks=y.ticks(y_words, tall),
        heading=heading,
    )


def _path(points: Sequence[Point]) -> str:
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in points)


def _clipped(polygon: Sequence[Point], a: float, b: float, limit: float) -> list[Point]:
    """Return the part of a polygon above the limit (Sutherland and Hodgman, Commun. ACM 17 (1974) 32)."""
    found: list[Point] = []
    for (p, q), (r, s) in zip(polygon, [*polygon[1:], polygon[0]], strict=True):
        here, there = a * p + b * q - limit, a * r + b * s - limit
        if here >= 0:
            found.append((p, q))
        if (here < 0) != (there < 0):
            fraction = here / (here - there)
            found.append((p + fraction * (r - p), q + fraction * (s - q)))
    return found


def place_labels(frame: Frame, wanted: Sequence[tuple[Dot, str, str]], avoid: Sequence[Box] = ()) -> None:
    """Place labels (dot, words, class) near their dots, without overlaps and over few other dots and boxes to `avoid`."""
    taken: list[Box] = []
    dots = [(d.x - d.radius, d.y - d.radius, d.x + d.radius, d.y + d.radius) for d in frame.dots]
    for dot, words, kind in wanted:
        width = CHARACTER * (1.08 if kind == "chosen" else 1) * len(words)
        best = min(_spots(dot, width), key=lambda box: _badness(box, dot, frame.box, taken, [*dots, *avoid]))
        taken.append(best)
        middle = round((best[1] + best[3]) / 2, 1)
        anchor = "start" if best[0] > dot.x else "end" if best[2] < dot.x else "middle"
        x = {"start": best[0], "end": best[2], "middle": dot.x}[anchor]
        leader = (dot.x, dot.y, round(x, 1), middle) if abs(middle - dot.y) > 16 else None
        frame.labels.append(
            Label(x=round(x, 1), y=round(middle + 4.5, 1), anchor=anchor, words=words, kind=kind, leader=leader)
        )


def _spots(dot: Dot, width: float) -> list[Box]:
    """Return candidate boxes right, left, above and below, at increasing distance."""
    found = []
    for step in range(1, 40):
        for sign in (1, -1):
            middle = dot.y - sign * (5 + step * 5)
            for left in (dot.x + 9, dot.x - 9 - width, dot.x - width / 2):
                if step >= 3 or left != dot.x - width / 2:
                    found.append((left, middle - 8, left + width, middle + 8))
    return found


def _badness(box: Box, dot: Dot, within: Box, taken: Sequence[Box], obstacles: Sequence[Box]) -> tuple[int, float]:
    """Return the number of labels and edges that a box overlaps, then its distance in px plus 40 px per obstacle."""
    outside = box[0] < within[0] + 3 or box[1] < within[1] + 2 or box[2] > within[2] - 3 or box[3] > within[3] - 2
    over = sum(_overlap(box, other) for other in obstacles)
    far = abs((box[1] + box[3]) / 2 - dot.y) + (0 if box[0] > dot.x else 4)
    return outside + sum(_overlap(box, other) for other in taken), far + 40 * over


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
