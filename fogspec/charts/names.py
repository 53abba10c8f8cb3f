"""Find places for names where they touch no dot, interval, limit or other name; there may be none."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Box = tuple[float, float, float, float]  # left, top, right, bottom in px; of a segment x, y, x, y
Rows = npt.NDArray[np.float64]  # of a box or a segment each
Flags = npt.NDArray[np.bool_]

# Candidates for the place of a name: px from its dot, degrees around it, parts of its width that it is moved by.
AWAY, ROUND, SLID = (3, 8, 16, 26, 38, 52, 68, 86, 106, 130, 160, 200, 250), range(0, 360, 15), (0.0, -0.25, 0.25)
BESIDE, ALONG = (3, 8, 14), 40  # px between the line of a limit and its words, and steps along it
NEAR, CLEAR = 14, 10  # px: a name further from its dot, or hardly nearer to it than to another, has a leader line
# What it costs, in px of distance: a leader line, a crossed line, and a leader line over another dot.
LED, PASSED, HIDDEN = 12, 60, 1000


@dataclass(slots=True)
class Taken:
    """What names must not touch: dots, names and lines; and the lines `soft` that they should not cross, in a frame."""

    within: Box
    dots: list[Box] = field(default_factory=list)
    names: list[Box] = field(default_factory=list)
    lines: list[Box] = field(default_factory=list)
    soft: list[Box] = field(default_factory=list)

    def beside(self, line: Box, wide: float, high: float) -> Box | None:
        """Return the place of words beside a line, at its upper or right end first; None if there is none."""
        (x1, y1), (x2, y2) = sorted((line[:2], line[2:]), key=lambda p: (-round(p[0]), p[1]))
        steps = [n / ALONG for n in range(ALONG + 1)]
        corners = [
            (x1 + n * (x2 - x1) + right, y1 + n * (y2 - y1) + down)
            for n in steps
            for by in BESIDE
            for right in (by + 3, -by - 3 - wide)
            for down in (-by - high, by)
        ]
        boxes = rows((x, y, x + wide, y + high) for x, y in corners).round(1)
        best = self._best(boxes, np.arange(len(boxes)) / 8)
        return None if best is None else box_of(boxes[best])

    def near(self, own: Box, wide: float, high: float) -> tuple[Box, Box | None] | None:
        """Return the place of a name near a dot's box, with a leader line if it needs one; None if there is none."""
        x, y, r = (own[0] + own[2]) / 2, (own[1] + own[3]) / 2, (own[2] - own[0]) / 2 - 1
        turns = [(math.cos(math.radians(angle)), math.sin(math.radians(angle))) for angle in ROUND]
        corners = [
            (x + dx * (r + away) - wide * ((1 - dx) / 2 - slid), y + dy * (r + away) - high * (1 - dy) / 2)
            for away in AWAY
            for dx, dy in turns
            for slid in SLID
        ]
        boxes = rows((left, top, left + wide, top + high) for left, top in corners).round(1)
        others = rows(box for box in (*self.dots, *self.names) if box != own)
        apart = distance(boxes, rows([own]))[:, 0]
        led = (apart >= NEAR) | (distance(boxes, others) < apart[:, None] + CLEAR).any(1)
        # The leader line goes from the edge of the dot to the nearest point of the name.
        to_x, to_y = np.clip(x, boxes[:, 0], boxes[:, 2]), np.clip(y, boxes[:, 1] + 2, boxes[:, 3] - 3)
        cut = (r + 1) / np.maximum(np.sqrt((to_x - x) ** 2 + (to_y - y) ** 2), r + 1)
        leaders = np.stack([x + cut * (to_x - x), y + cut * (to_y - y), to_x, to_y], axis=1).round(1)
        cost = apart + 0.05 * abs((boxes[:, 1] + boxes[:, 3]) / 2 - y) + np.where(boxes[:, 0] > x, 0, 1.5)
        crossed = meeting(leaders, rows(self.lines)).sum(1)
        cost += led * (LED * (1 + crossed) + HIDDEN * through(others, leaders).any(0))
        cost[led & through(rows(self.names), leaders).any(0)] = np.inf
        best = self._best(boxes, cost)
        return None if best is None else (box_of(boxes[best]), box_of(leaders[best]) if led[best] else None)

    def _best(self, boxes: Rows, cost: Rows) -> int | None:
        """Return the index of the cheapest box that is inside and touches nothing."""
        (left, top, right, bottom), w = boxes.T, self.within
        free = (left >= w[0] + 2) & (top >= w[1] + 1) & (right <= w[2] - 2) & (bottom <= w[3] - 1)
        free &= ~(distance(boxes, rows([*self.dots, *self.names])) == 0).any(1)
        free &= ~through(boxes, rows(self.lines)).any(1)
        cost = np.where(free, cost + PASSED * through(boxes, rows(self.soft)).sum(1), np.inf)
        best = int(cost.round(6).argmin())
        return best if math.isfinite(cost[best]) else None


def rows(items: Iterable[Box]) -> Rows:
    """Return boxes or segments as an array (n, 4)."""
    return np.array(list(items), dtype=float).reshape(-1, 4)


def box_of(row: Rows) -> Box:
    """Return a row of an array as a box."""
    left, top, right, bottom = row.tolist()
    return left, top, right, bottom


def distance(boxes: Rows, others: Rows) -> Rows:
    """Return the distances (n, m) between boxes in px, 0 where they overlap."""
    a, b = boxes.T[:, :, None], others.T[:, None, :]
    dx, dy = (np.maximum(np.maximum(a[i] - b[i + 2], b[i] - a[i + 2]), 0) for i in (0, 1))
    return np.asarray(np.sqrt(dx * dx + dy * dy))


def through(boxes: Rows, lines: Rows) -> Flags:
    """Return which segments go through which boxes (n, m): near them, and with corners on both sides."""
    (left, top, right, bottom), (x1, y1, x2, y2) = boxes.T[:, :, None], lines.T[:, None, :]
    near = (np.minimum(x1, x2) <= right) & (np.maximum(x1, x2) >= left)
    near &= (np.minimum(y1, y2) <= bottom) & (np.maximum(y1, y2) >= top)
    sides = np.stack([(x2 - x1) * (y - y1) - (y2 - y1) * (x - x1) for x in (left, right) for y in (top, bottom)])
    return np.asarray(near & (sides.min(0) <= 0) & (sides.max(0) >= 0))


def meeting(lines: Rows, others: Rows) -> Flags:
    """Return which segments cross which (n, m): the ends of each are on both sides of the other."""
    a, b = lines.T[:, :, None], others.T[:, None, :]

    def side(one: Rows, x: Rows, y: Rows) -> Rows:
        return np.asarray((one[2] - one[0]) * (y - one[1]) - (one[3] - one[1]) * (x - one[0]))

    return np.asarray((side(a, b[0], b[1]) * side(a, b[2], b[3]) < 0) & (side(b, a[0], a[1]) * side(b, a[2], a[3]) < 0))
