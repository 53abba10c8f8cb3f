"""Antipodal grasps of a depth image, sampled and refined by the cross-entropy method, as Dex-Net's policy does."""

from dataclasses import dataclass

import numpy as np

from grasp_planning.network import CROP, Network
from grasp_planning.scene import METRES_PER_PIXEL

GRIPPER_M = 0.06  # the widest opening
EDGE_M = 0.006  # a step of the depth between two pixels that is an edge of an object
FRICTION_RAD = 0.35
ITERATIONS, ELITE = 3, 0.25
SPREAD = np.array([2.0, 2.0, 0.15])  # pixels, pixels, radians: how far samples are from the elite


@dataclass(frozen=True)
class Grasp:
    """The middle in pixels, the jaws' axis in radians, the depth in metres, and what the network makes of it."""

    x: float
    y: float
    angle: float
    depth_m: float
    quality: float


def plan(depth: np.ndarray, network: Network, samples: int, random: np.random.Generator) -> list[Grasp]:
    """Return the grasps of a depth image (h, w) that are antipodal, best first; none if there is none."""
    edges = Edges(depth)
    kept = edges.sample(samples, random)
    found: list[Grasp] = []
    for _ in range(ITERATIONS):
        if not len(kept):
            break
        depths = np.array([edges.depth_m(one) for one in kept], np.float32)
        qualities = network.qualities(crops(depth, kept, depths), depths)
        found += [
            Grasp(*map(float, one), float(z), float(q)) for one, z, q in zip(kept, depths, qualities, strict=True)
        ]
        elite = kept[np.argsort(-qualities)[: max(1, int(ELITE * len(kept)))]]
        drawn = elite[random.integers(0, len(elite), 4 * samples)] + random.normal(0, 1, (4 * samples, 3)) * SPREAD
        kept = np.array([one for one in drawn if edges.antipodal(one)][:samples]).reshape(-1, 3)
    return sorted(found, key=lambda grasp: -grasp.quality)


def crops(depth: np.ndarray, grasps: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return the image around each grasp (n, 32, 32), turned so that its axis is a row, relative to its depth."""
    steps = (np.arange(CROP) - CROP / 2 + 0.5) * 1.5
    v, u = np.meshgrid(steps, steps, indexing="ij")
    cos, sin = np.cos(grasps[:, 2])[:, None, None], np.sin(grasps[:, 2])[:, None, None]
    x = (grasps[:, 0, None, None] + u * cos - v * sin).round().astype(int).clip(0, depth.shape[1] - 1)
    y = (grasps[:, 1, None, None] + u * sin + v * cos).round().astype(int).clip(0, depth.shape[0] - 1)
    return (depth[y, x] - depths[:, None, None]).astype(np.float32)


class Edges:
    """The edges of objects in a depth image, with the direction in which each falls away."""

    def __init__(self, depth: np.ndarray) -> None:
        self.depth = depth
        down, right = np.gradient(depth.astype(float))
        self.angle = np.arctan2(down, right)
        self.is_edge = np.hypot(down, right) > EDGE_M / 2
        self.pixels = np.argwhere(self.is_edge)[:, ::-1]

    def sample(self, count: int, random: np.random.Generator) -> np.ndarray:
        """Return up to so many antipodal grasps (n, 3): x, y, angle."""
        found: list[tuple[float, float, float]] = []
        if not len(self.pixels):
            return np.zeros((0, 3))
        for x, y in self.pixels[random.integers(0, len(self.pixels), 12 * count)]:
            angle = self.angle[y, x] + np.pi  # into the object
            for width in np.arange(6.0, GRIPPER_M / METRES_PER_PIXEL):
                one = (x + np.cos(angle) * width / 2, y + np.sin(angle) * width / 2, angle)
                if self.antipodal(np.array(one)):
                    found.append(one)
                    break
            if len(found) == count:
                break
        return np.array(found).reshape(-1, 3)

    def antipodal(self, grasp: np.ndarray) -> bool:
        """Whether jaws that close along the grasp's axis meet two edges that face away from each other, by friction."""
        x, y, angle = grasp
        for side in (1, -1):
            edge = self._first_edge(x, y, angle if side == 1 else angle + np.pi)
            if edge is None:
                return False
            # An edge falls away from the object: in the direction from the middle of the grasp to the edge.
            outwards = self.angle[edge[1], edge[0]] - (angle if side == 1 else angle + np.pi)
            if abs((outwards + np.pi) % (2 * np.pi) - np.pi) > FRICTION_RAD:
                return False
        return True

    def depth_m(self, grasp: np.ndarray) -> float:
        """Return the depth of the surface in the middle of a grasp."""
        x, y = round(float(grasp[0])), round(float(grasp[1]))
        return float(self.depth[min(max(y, 0), self.depth.shape[0] - 1), min(max(x, 0), self.depth.shape[1] - 1)])

    def _first_edge(self, x: float, y: float, angle: float) -> tuple[int, int] | None:
        for step in np.arange(0.0, GRIPPER_M / METRES_PER_PIXEL / 2):
            column, row = round(x + np.cos(angle) * step), round(y + np.sin(angle) * step)
            if not (0 <= row < self.depth.shape[0] and 0 <= column < self.depth.shape[1]):
                return None
            if self.is_edge[row, column]:
                return column, row
        return None
