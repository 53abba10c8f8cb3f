"""Lay out one coordinate system of a chart: axes, marks, limits, and labels that touch none of them."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from fogspec.charts.axes import Axis, tall, wide
from fogspec.charts.text import LABEL, SIZE, width

Point = tuple[float, float]
Box = tuple[float, float, float, float]
Segment = tuple[float, float, float, float]

ROUND = range(0, 360, 15)
AWAY = (3, 8, 16, 26, 38, 52, 68, 86, 106, 130, 160, 200, 250, 310)


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """A label next to a point, with a leader line if it was moved away or another mark is nearer."""

    x: float
    y: float
    anchor: str
    words: str
    kind: str
    leader: Segment | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A machine: `kind` are its CSS classes, `bar` its interval as a segment, `title` the text for screen readers.

    `row` is the machine's row, by which the report's page finds the mark.
    """

    x: float
    y: float
    kind: str
    radius: float
    title: str
    diamond: bool = False
    bar: Segment | None = None
    row: int | None = None

    @property
    def box(self) -> Box:
        """The mark's edges, in px."""
        r = self.radius * (1.25 if self.diamond else 1) + 1
        return self.x - r, self.y - r, self.x + r, self.y + r

    @property
    def path(self) -> str:
        """The outline of a diamond."""
        r = round(self.radius * 1.25, 1)
        return f"M{self.x:g} {round(self.y - r, 1):g}l{r:g} {r:g}l{-r:g} {r:g}l{-r:g} {-r:g}z"


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitLine:
    """The line of a limit inside the frame, with its label."""

    name: str
    segment: Segment
    words: str


@dataclass(slots=True, kw_only=True)
class Frame:
    """One coordinate system as the template draws it; `specks`, `lines` and `areas` are (class, path) pairs.

    `remark` is next to the label of the vertical axis; a narrow picture has it `above`, as lines (y, words).
    """

    x: Axis
    y: Axis
    x_label: str
    y_label: str
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]
    heading: str = ""
    remark: str = ""
    above: list[tuple[float, str]] = field(default_factory=list)
    areas: list[tuple[str, str]] = field(default_factory=list)
    lines: list[tuple[str, str]] = field(default_factory=list)
    specks: list[tuple[str, str]] = field(default_factory=list)
    limits: list[LimitLine] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)

    @property
    def box(self) -> Box:
        """The left, top, right and bottom edges, in px."""
        return self.x.start, self.y.end, self.x.end, self.y.start


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


def path(points: Iterable[Point]) -> str:
    """Return an SVG path through the points."""
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in points)


def corners(found: Frame) -> list[Point]:
    """Return the corners of the frame, as logarithms to the base 10."""
    x, y = found.x, found.y
    return [(x.low, y.low), (x.high, y.low), (x.high, y.high), (x.low, y.high)]


def below(polygon: Sequence[Point], a: float, b: float, limit: float) -> list[Point]:
    """Return the part of a polygon with a·x + b·y at most the limit (Sutherland and Hodgman, Commun. ACM 17 (1974) 32)."""
    found: list[Point] = []
    for (p, q), (r, s) in zip(polygon, [*polygon[1:], *polygon[:1]], strict=True):
        here, there = a * p + b * q - limit, a * r + b * s - limit
        if here <= 0:
            found.append((p, q))
        if (here > 0) != (there > 0):
            fraction = here / (here - there)
            found.append((p + fraction * (r - p), q + fraction * (s - q)))
    return found


def edge(found: Frame, a: float, b: float, limit: float) -> Segment | None:
    """Return where a·log10 x + b·log10 y equals the limit, in px; None outside of the frame."""
    inside = below(corners(found), a, b, limit)
    on = [(p, q) for p, q in inside if abs(a * p + b * q - limit) < 1e-9]
    if len(on) < 2 or len(inside) < 3 or len(below(corners(found), -a, -b, -limit)) < 3:
        return None
    (p, q), (r, s) = on[0], on[-1]
    return found.x.place(p), found.y.place(q), found.x.place(r), found.y.place(s)


def clipped(segment: Segment, box: Box) -> Segment | None:
    """Return the part of a segment within a box (Liang and Barsky, ACM TOG 3 (1984) 1); None if there is none."""
    x, y, dx, dy = segment[0], segment[1], segment[2] - segment[0], segment[3] - segment[1]
    low, high = 0.0, 1.0
    for step, room in ((-dx, x - box[0]), (dx, box[2] - x), (-dy, y - box[1]), (dy, box[3] - y)):
        if step == 0:
            if room < 0:
                return None
        elif step < 0:
            low = max(low, room / step)
        else:
            high = min(high, room / step)
    if low > high:
        return None
    one = (x + low * dx, y + low * dy, x + high * dx, y + high * dy)
    return tuple(round(value, 1) for value in one)  # type: ignore[return-value]


def crosses(segment: Segment, box: Box) -> bool:
    """Return whether a part of a segment lies within a box. Most segments are beside a box, which is seen at once."""
    x1, y1, x2, y2 = segment
    if (x1 < box[0] - 1 and x2 < box[0] - 1) or (x1 > box[2] + 1 and x2 > box[2] + 1):
        return False
    if (y1 < box[1] - 1 and y2 < box[1] - 1) or (y1 > box[3] + 1 and y2 > box[3] + 1):
        return False
    return clipped(segment, box) is not None


@dataclass(slots=True)
class Obstacles:
    """What a label must not touch, and the segments that it should not cross."""

    within: Box
    boxes: list[Box]
    lines: list[Segment]
    soft: list[Segment]

    @classmethod
    def of(cls, found: Frame, soft: Sequence[Segment] = ()) -> "Obstacles":
        """Return what is in a frame so far."""
        bars = [mark.bar for mark in found.marks if mark.bar]
        return cls(found.box, [mark.box for mark in found.marks], [one.segment for one in found.limits], [*bars, *soft])

    def touched(self, box: Box) -> int:
        """Return how many of the edges, marks, limits and labels a box touches."""
        w = self.within
        outside = box[0] < w[0] + 2 or box[1] < w[1] + 1 or box[2] > w[2] - 2 or box[3] > w[3] - 1
        marks = sum(_overlap(box, other) for other in self.boxes)
        return outside + marks + sum(crosses(line, box) for line in self.lines)

    def blocked(self, leader: Segment | None, mark: Mark) -> bool:
        """Return True if a leader line from a mark goes through another mark or a label."""
        return leader is not None and any(crosses(leader, box) for box in self.boxes if box != mark.box)

    def crossed(self, box: Box) -> int:
        """Return how many other lines go through a box."""
        return sum(crosses(line, box) for line in self.soft)


def place_limits(found: Frame, obstacles: Obstacles) -> None:
    """Label the limit lines where the labels touch nothing: along the line, on either side of it."""
    for limit in found.limits:
        room, size = width(limit.words) + 4, SIZE
        best: tuple[float, Box] | None = None
        own = Obstacles(
            obstacles.within,
            obstacles.boxes,
            [line for line in obstacles.lines if line != limit.segment],
            obstacles.soft,
        )
        for rank, box in enumerate(_along(limit.segment, room, size + 4)):
            if own.touched(box) or crosses(limit.segment, box):
                continue
            bad = 50 * own.crossed(box) + rank
            if best is None or bad < best[0]:
                best = bad, box
        if best is not None:
            box = best[1]
            obstacles.boxes.append(box)
            found.labels.append(
                Label(
                    x=round(box[0] + 2, 1), y=round(box[3] - 5, 1), anchor="start", words=limit.words, kind="of-limit"
                )
            )


def _along(segment: Segment, room: float, high: float) -> Iterable[Box]:
    """Yield boxes beside a line, the far end of it first."""
    x1, y1, x2, y2 = segment
    # From the upper or the right end on, where labels of limits are looked for.
    if (abs(x2 - x1) < 1 and y1 > y2) or (abs(x2 - x1) >= 1 and x1 < x2):
        x1, y1, x2, y2 = x2, y2, x1, y1
    steep = abs(y2 - y1) > abs(x2 - x1)
    for step in range(41):
        x, y = x1 + step / 40 * (x2 - x1), y1 + step / 40 * (y2 - y1)
        if steep:
            for left in (x + 6, x - 6 - room):
                yield left, y + 4, left + room, y + 4 + high
        else:
            for top in (y - 3 - high, y + 3):
                yield x - room - 3, top, x - 3, top + high


def place_labels(found: Frame, wanted: Sequence[tuple[Mark, str, str]], obstacles: Obstacles) -> None:
    """Place labels (mark, words, class) near their marks, where they touch nothing; one without such a place is left out."""
    others = [mark.box for mark in found.marks]
    for mark, words, kind in wanted:
        room = width(words, LABEL, bold=True) + 2
        best: tuple[float, Box] | None = None
        for away in AWAY:
            if best is not None and best[0] <= away:
                break  # what is further away is worse
            free = [box for box in _spots(mark, room, away) if not obstacles.touched(box)]
            best = min(
                [*((_badness(box, mark, obstacles, others), box) for box in free), *([best] if best else [])],
                default=None,
            )
        if best is None:
            continue
        box, leader = best[1], _leader(best[1], mark, others)
        obstacles.boxes.append(box)
        if leader is not None:
            obstacles.lines.append(leader)
        found.labels.append(
            Label(
                x=round(box[0] + 1, 1),
                y=round(box[3] - 5, 1),
                anchor="start",
                words=words,
                kind=kind,
                leader=leader,
            )
        )


def _spots(mark: Mark, room: float, away: float) -> Iterable[Box]:
    """Yield candidate boxes around a mark, so far away; each faces the mark with one side."""
    high = LABEL + 5
    for angle in ROUND:
        dx, dy = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        x, y = mark.x + dx * (mark.radius + away), mark.y + dy * (mark.radius + away)
        left, top = x - room * (1 - dx) / 2, y - high * (1 - dy) / 2
        yield left, top, left + room, top + high


def _badness(box: Box, mark: Mark, obstacles: Obstacles, others: Sequence[Box]) -> float:
    own = _distance(box, mark)
    nearer = any(_apart(box, other) < own for other in others if other != mark.box)
    middle = abs((box[1] + box[3]) / 2 - mark.y)
    return own + 16 * obstacles.crossed(box) + 14 * nearer + 0.05 * middle + (0 if box[0] > mark.x else 1.5)


def _leader(box: Box, mark: Mark, others: Sequence[Box]) -> Segment | None:
    own = _distance(box, mark)
    if own < 14 and not any(_apart(box, other) < own for other in others if other != mark.box):
        return None
    x, y = min(max(mark.x, box[0]), box[2]), min(max(mark.y, box[1] + 2), box[3] - 3)
    long = math.hypot(x - mark.x, y - mark.y)
    if long <= mark.radius + 1:
        return None
    cut = (mark.radius + 1) / long
    start = mark.x + cut * (x - mark.x), mark.y + cut * (y - mark.y)
    return round(start[0], 1), round(start[1], 1), round(x, 1), round(y, 1)


def _distance(box: Box, mark: Mark) -> float:
    return _apart(box, mark.box)


def _apart(one: Box, other: Box) -> float:
    dx = max(one[0] - other[2], other[0] - one[2], 0)
    dy = max(one[1] - other[3], other[1] - one[3], 0)
    return math.hypot(dx, dy)


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def segments(points: Sequence[Point]) -> list[Segment]:
    """Return the segments between successive points."""
    return [(a, b, c, d) for (a, b), (c, d) in pairwise(points)]
