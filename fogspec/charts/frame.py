"""Lay out one coordinate system of a chart: axes, marks, limits, and labels that touch none of them."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, permutations

import numpy as np
import numpy.typing as npt

from fogspec.charts.axes import Axis, tall, wide
from fogspec.charts.text import LABEL, SIZE, width

Point = tuple[float, float]
Box = tuple[float, float, float, float]
Segment = tuple[float, float, float, float]
Rows = npt.NDArray[np.float64]  # of a box or a segment each
Flags = npt.NDArray[np.bool_]

ROUND = range(0, 360, 15)
AWAY = (3, 8, 16, 26, 38, 52, 68, 86, 106, 130, 160, 200, 250, 310)
SLID = (0.0, -0.25, 0.25)  # by this part of its width a label is further to the right
EDGE = 16.0  # px to the right of a frame, beyond which a picture ends
BESIDE = (3, 8, 14)  # px between the line of a limit and its label
# What a label costs, in px of its distance: no place at all, a leader line through a mark or a label, crossing an interval,
# crossing another line, a leader line and each interval that it crosses.
MISSING, BLOCKED, CROSSED, PASSED, LED = 10_000, 1000, 100, 40, 12
CLEAR = 10  # px that another mark is further away than its own, or the label has a leader line
ORDERED = 4  # labels whose best order is searched


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

    @property
    def short(self) -> str:
        """The label without the name, which the axis has."""
        return f"limit{self.words.rpartition(' limit')[2]}"

    @property
    def level(self) -> bool:
        """Whether the line is horizontal."""
        return self.segment[1] == self.segment[3]


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
        x_ticks=[(at, words) for at, words in x.ticks(x_words, wide) if at + width(words) / 2 <= x.end + EDGE],
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


@dataclass(slots=True)
class Obstacles:
    """What a label must not touch, and the intervals and other segments that it should not cross."""

    within: Box
    boxes: list[Box]
    lines: list[Segment]
    bars: list[Segment]
    soft: Sequence[Segment]

    @classmethod
    def of(cls, found: Frame, soft: Sequence[Segment] = ()) -> "Obstacles":
        """Return what is in a frame so far."""
        bars = [mark.bar for mark in found.marks if mark.bar]
        return cls(found.box, [mark.box for mark in found.marks], [one.segment for one in found.limits], bars, soft)

    def free(self, boxes: Rows) -> Flags:
        """Return which boxes touch none of the edges, marks, limits and labels."""
        left, top, right, bottom = boxes.T
        w = self.within
        inside = (left >= w[0] + 2) & (top >= w[1] + 1) & (right <= w[2] - 2) & (bottom <= w[3] - 1)
        taken = _overlap(boxes, _rows(self.boxes)).any(1) | _through(boxes, _rows(self.lines)).any(1)
        return np.asarray(inside & ~taken)

    def crossed(self, boxes: Rows) -> Rows:
        """Return the cost of the lines that go through each box."""
        bars, soft = (_through(boxes, _rows(lines)).sum(1) for lines in (self.bars, self.soft))
        return np.asarray(CROSSED * bars + PASSED * soft, dtype=float)


def place_limits(found: Frame, obstacles: Obstacles) -> None:
    """Label the limit lines where the labels touch nothing: along the line, on either side of it.

    A label that would cross an interval is shortened, unless it would not say of which limit it is.
    """
    for limit in found.limits:
        alone = sum(one.level == limit.level for one in found.limits) == 1
        texts = (limit.words, limit.short) if alone else (limit.words,)
        crossed, box, words = min((_place_limit(limit, text, obstacles) for text in texts), key=lambda place: place[0])
        if math.isfinite(crossed):
            obstacles.boxes.append(box)
            found.labels.append(_label(box, words, "of-limit", inset=2))


def _place_limit(limit: LimitLine, words: str, obstacles: Obstacles) -> tuple[float, Box, str]:
    """Return the best place for a label of a limit: the cost of the lines through it, its box, and the label."""
    boxes = _rows(_along(limit.segment, width(words) + 4, SIZE + 4))
    crossed = np.where(obstacles.free(boxes), obstacles.crossed(boxes), np.inf)
    at = int((crossed + np.arange(len(boxes)) / len(BESIDE)).argmin())
    box: Box = tuple(boxes[at].tolist())
    return float(crossed[at]), box, words


def _label(box: Box, words: str, kind: str, *, inset: float = 1, leader: Segment | None = None) -> Label:
    x, y = round(box[0] + inset, 1), round(box[3] - 5, 1)
    return Label(x=x, y=y, anchor="start", words=words, kind=kind, leader=leader)


def _along(segment: Segment, room: float, high: float) -> list[Box]:
    """Return boxes beside a line, the far end of it first."""
    x1, y1, x2, y2 = segment
    # From the upper or the right end on, where labels of limits are looked for.
    if (abs(x2 - x1) < 1 and y1 > y2) or (abs(x2 - x1) >= 1 and x1 < x2):
        x1, y1, x2, y2 = x2, y2, x1, y1
    steep = abs(y2 - y1) > abs(x2 - x1)
    found = []
    for step in range(41):
        x, y = x1 + step / 40 * (x2 - x1), y1 + step / 40 * (y2 - y1)
        if steep:
            sides = [left for by in BESIDE for left in (x + by + 3, x - by - 3 - room)]
            found += [(left, y + 4, left + room, y + 4 + high) for left in sides]
        else:
            sides = [top for by in BESIDE for top in (y - by - high, y + by)]
            found += [(x - room - 3, top, x - 3, top + high) for top in sides]
    return found


@dataclass(frozen=True, slots=True)
class _Places:
    """The places that a label could have: its boxes, its leader lines (NaN for none) and what each place costs."""

    boxes: Rows
    leaders: Rows
    cost: Rows

    def best(self, placed: Sequence[tuple["_Places", int]]) -> int:
        """Return the place of least cost beside labels that have their place."""
        cost = self.cost.copy()
        for other, at in placed:
            box, leader = other.boxes[at : at + 1], other.leaders[at : at + 1]
            cost[_overlap(self.boxes, box)[:, 0] | _through(self.boxes, leader)[:, 0]] = np.inf
            cost[_through(box, self.leaders)[0]] += BLOCKED
        return int(cost.argmin()) if np.isfinite(cost).any() else -1


def place_labels(found: Frame, wanted: Sequence[tuple[Mark, str, str]], obstacles: Obstacles) -> None:
    """Place labels (mark, words, class) near their marks, where they touch nothing; one without such a place is left out.

    Of a few labels, the order of placement with the least cost is searched.
    """
    places = [_places(mark, width(words, LABEL, bold=True) + 2, obstacles, found.marks) for mark, words, _ in wanted]
    some = range(len(wanted))
    best, least = {}, math.inf
    for order in permutations(some) if len(wanted) <= ORDERED else [some]:
        chosen: dict[int, int] = {}
        for i in order:
            at = places[i].best([(places[j], k) for j, k in chosen.items()])
            if at >= 0:
                chosen[i] = at
        cost = sum(float(places[i].cost[at]) for i, at in chosen.items()) + MISSING * (len(wanted) - len(chosen))
        if cost < least:
            best, least = chosen, cost
    for i, at in sorted(best.items()):
        box: Box = tuple(places[i].boxes[at].tolist())
        ends = places[i].leaders[at]
        leader: Segment | None = None if np.isnan(ends).any() else tuple(ends.round(1).tolist())
        obstacles.boxes.append(box)
        found.labels.append(_label(box, *wanted[i][1:], leader=leader))


def _places(mark: Mark, room: float, obstacles: Obstacles, marks: Sequence[Mark]) -> _Places:
    """Return the places around a mark where its label touches nothing."""
    boxes = _rows(_spots(mark, room))
    boxes = boxes[obstacles.free(boxes)]
    left, top, right, bottom = boxes.T
    own = _apart(boxes, _rows([mark.box]))[:, 0]
    others = _rows([box for box in obstacles.boxes if box != mark.box])
    nearer = (_apart(boxes, _rows([one.box for one in marks if one.box != mark.box])) < own[:, None] + CLEAR).any(1)
    # The leader line goes from the edge of the mark to the nearest point of the label.
    x, y = np.clip(mark.x, left, right), np.clip(mark.y, top + 2, bottom - 3)
    long = np.hypot(x - mark.x, y - mark.y)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = (mark.radius + 1) / long
        ends = np.stack([mark.x + cut * (x - mark.x), mark.y + cut * (y - mark.y), x, y], axis=1)
    led = (own >= 14) | nearer
    leaders = np.where((led & (long > mark.radius + 1))[:, None], ends, np.nan)
    met = _meet(leaders, _rows([bar for bar in obstacles.bars if bar != mark.bar])).sum(1)
    cost = own + 0.05 * abs((top + bottom) / 2 - mark.y) + np.where(left > mark.x, 0, 1.5)
    cost += obstacles.crossed(boxes) + LED * (led + met) + BLOCKED * _through(others, leaders).sum(0)
    return _Places(boxes, leaders, cost.round(6))


def _spots(mark: Mark, room: float) -> Iterable[Box]:
    """Yield boxes around a mark, the nearest first; each faces the mark with one side."""
    high = LABEL + 5
    for away in AWAY:
        for angle in ROUND:
            dx, dy = math.cos(math.radians(angle)), math.sin(math.radians(angle))
            x, y = mark.x + dx * (mark.radius + away), mark.y + dy * (mark.radius + away)
            for slid in SLID:
                left, top = x - room * ((1 - dx) / 2 - slid), y - high * (1 - dy) / 2
                yield left, top, left + room, top + high


def _rows(items: Iterable[tuple[float, float, float, float]]) -> Rows:
    return np.array(list(items), dtype=float).reshape(-1, 4)


def _pairs(ones: Rows, others: Rows) -> tuple[Rows, Rows]:
    """Return the columns of both, so that a result has a row for each of the first and a column for each of the others."""
    return ones.T[:, :, None], others.T[:, None, :]


def _apart(boxes: Rows, others: Rows) -> Rows:
    """Return the distances between boxes."""
    a, b = _pairs(boxes, others)
    dx, dy = np.maximum(a[0] - b[2], b[0] - a[2]), np.maximum(a[1] - b[3], b[1] - a[3])
    return np.asarray(np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)))


def _overlap(boxes: Rows, others: Rows) -> Flags:
    a, b = _pairs(boxes, others)
    return np.asarray((a[0] < b[2]) & (b[0] < a[2]) & (a[1] < b[3]) & (b[1] < a[3]))


def _through(boxes: Rows, lines: Rows) -> Flags:
    """Return which segments go through which boxes: near them, and with corners on both sides. None do that are NaN."""
    (left, top, right, bottom), (x1, y1, x2, y2) = _pairs(boxes, lines)
    near = (np.minimum(x1, x2) <= right) & (np.maximum(x1, x2) >= left)
    near &= (np.minimum(y1, y2) <= bottom) & (np.maximum(y1, y2) >= top)
    sides = np.stack([(x2 - x1) * (y - y1) - (y2 - y1) * (x - x1) for x in (left, right) for y in (top, bottom)])
    return np.asarray(near & (sides.min(0) <= 0) & (sides.max(0) >= 0))


def _meet(lines: Rows, others: Rows) -> Flags:
    """Return which segments cross which: the ends of each are on both sides of the other."""
    a, b = _pairs(lines, others)

    def side(line: Rows, x: Rows, y: Rows) -> Rows:
        return np.asarray((line[2] - line[0]) * (y - line[1]) - (line[3] - line[1]) * (x - line[0]))

    return np.asarray((side(a, b[0], b[1]) * side(a, b[2], b[3]) < 0) & (side(b, a[0], a[1]) * side(b, a[2], a[3]) < 0))


def segments(points: Sequence[Point]) -> list[Segment]:
    """Return the segments between successive points."""
    return [(a, b, c, d) for (a, b), (c, d) in pairwise(points)]
