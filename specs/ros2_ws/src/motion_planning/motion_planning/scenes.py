"""Scenes of boxes, and an L-shaped body of spheres that is moved through them."""

from dataclasses import dataclass

import numpy as np

# Centres in the body's frame, in metres, and one radius.
BODY = np.array([[-0.6, 0, 0], [0, 0, 0], [0.6, 0, 0], [0.6, 0.45, 0], [0.6, 0.9, 0]])
RADIUS_M = 0.25
HEIGHT_M = 3.0


@dataclass(frozen=True)
class Scene:
    """Bounds from the origin to `size`, boxes by their corners (b, 3), and the two poses (x, y, z, qw, qx, qy, qz)."""

    size: np.ndarray
    low: np.ndarray
    high: np.ndarray
    start: np.ndarray
    goal: np.ndarray

    def free(self, pose: np.ndarray) -> bool:
        """Whether the body at a pose (7,) touches neither a box nor the bounds."""
        centres = BODY @ rotation(pose[3:]).T + pose[:3]
        if (centres < RADIUS_M).any() or (centres > self.size - RADIUS_M).any():
            return False
        points = centres[:, None]
        gap = np.maximum(np.maximum(self.low - points, points - self.high), 0)
        return bool((np.einsum("pbi,pbi->pb", gap, gap) > RADIUS_M**2).all())


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _wall(along: int, at: float, length: float, doors: list[tuple[float, float]]) -> list[tuple[float, ...]]:
    """Return the boxes of a wall along axis `along` (0 = x) with doors from, to."""
    edges = [0.0, *(edge for door in doors for edge in door), length]
    pieces = zip(edges[::2], edges[1::2], strict=True)
    if along == 0:
        return [(a, at, 0, b, at + 0.2, HEIGHT_M) for a, b in pieces]
    return [(at, a, 0, at + 0.2, b, HEIGHT_M) for a, b in pieces]


def _scene(size: tuple[float, float], boxes: list[tuple[float, ...]], start: list[float], goal: list[float]) -> Scene:
    corners = np.array(boxes)
    turn = [1.0, 0.0, 0.0, 0.0]
    return Scene(
        np.array([*size, HEIGHT_M]), corners[:, :3], corners[:, 3:], np.array(start + turn), np.array(goal + turn)
    )


def cubicles() -> Scene:
    """Return a floor of twelve rooms with two doors in each wall."""
    boxes = []
    for x, doors in ((5.0, (2.0, 9.0)), (10.0, (6.0, 13.0)), (15.0, (3.0, 10.0))):
        boxes += _wall(1, x, 16.0, [(door, door + 2.6) for door in doors])
    for y, doors in ((5.3, (2.5, 12.0)), (10.6, (7.0, 17.0))):
        boxes += _wall(0, y, 20.0, [(door, door + 2.6) for door in doors])
    boxes += [(x, y, 0, x + 1.2, y + 0.8, 1.0) for x in (0.3, 6.0, 11.5, 16.5) for y in (3.6, 8.4, 12.4)]
    return _scene((20.0, 16.0), boxes, [1.5, 1.5, 1.5], [18.5, 14.5, 1.5])


def apartment() -> Scene:
    """Return four rooms around a hall, with furniture: the way leads through two doors."""
    boxes = [
        *_wall(1, 4.0, 9.0, [(1.2, 3.4), (6.0, 8.2)]),
        *_wall(1, 8.0, 9.0, [(1.6, 3.8), (5.6, 7.8)]),
        (0, 4.4, 0, 4.0, 4.6, HEIGHT_M),
        (8.2, 4.4, 0, 12.0, 4.6, HEIGHT_M),
        (0.3, 0.3, 0, 1.2, 2.0, 0.9),
        (5.2, 0.3, 0, 6.8, 1.0, 1.1),
        (9.6, 2.2, 0, 11.0, 3.0, 0.8),
        (5.6, 4.4, 0, 6.6, 5.4, 1.2),
        (0.3, 7.6, 0, 2.3, 8.7, 0.6),
        (10.4, 7.4, 0, 11.7, 8.7, 0.9),
    ]
    return _scene((12.0, 9.0), boxes, [2.6, 1.4, 1.6], [10.2, 6.2, 1.6])


SCENES = {"cubicles": cubicles, "apartment": apartment}
