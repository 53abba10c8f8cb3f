"""A synthetic RGB-D camera in a textured room, with known truth: every image is the exact view of its pose."""

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL_PX = 480, 360, 390.0
# The middle of the pixel in row and column 0 is (0, 0).
CAMERA = np.array([[FOCAL_PX, 0, WIDTH / 2 - 0.5], [0, FOCAL_PX, HEIGHT / 2 - 0.5], [0, 0, 1]])
ROOM_M = np.array([4.0, 3.0, 1.5])  # half of its size in each direction
TEXELS_PER_M = 160


class Room:
    """Six textured walls around the origin; `seed` draws the textures."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        self.textures = {}
        for axis in range(3):
            u, v = (ROOM_M[[i for i in range(3) if i != axis]] * 2 * TEXELS_PER_M).astype(int)
            for side in (0, 1):
                self.textures[axis, side] = _texture(random, int(u), int(v))
        x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        self.rays = np.stack([(x - WIDTH / 2) / FOCAL_PX, (y - HEIGHT / 2) / FOCAL_PX, np.ones_like(x)], axis=-1)

    def view(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the grey image (h, w) uint8 and the depth in metres (h, w) float32 of a camera at `pose` (4, 4)."""
        ways, origin = self.rays @ pose[:3, :3].T, pose[:3, 3]
        with np.errstate(divide="ignore"):
            ahead = np.where(ways > 0, (ROOM_M - origin) / ways, (-ROOM_M - origin) / ways)
        axis = ahead.argmin(axis=-1)
        depth = ahead.min(axis=-1)
        points = origin + ways * depth[..., None]
        image = np.zeros((HEIGHT, WIDTH), np.uint8)
        for (of, side), texture in self.textures.items():
            seen = (axis == of) & ((ways[..., of] > 0) == bool(side))
            others = [i for i in range(3) if i != of]
            texels = ((points[seen][:, others] + ROOM_M[others]) * TEXELS_PER_M).astype(int)
            image[seen] = texture[
                texels[:, 0].clip(0, texture.shape[0] - 1), texels[:, 1].clip(0, texture.shape[1] - 1)
            ]
        return cv2.GaussianBlur(image, (3, 3), 0.8), depth.astype(np.float32)


def _texture(random: np.random.Generator, u: int, v: int) -> np.ndarray:
    """Return grey rectangles of many sizes on smooth noise."""
    coarse = random.integers(60, 160, (u // 80 + 2, v // 80 + 2)).astype(np.uint8)
    texture = cv2.resize(coarse, (v, u), interpolation=cv2.INTER_CUBIC)
    for _ in range(u * v // 1600):
        a, b = int(random.integers(0, u)), int(random.integers(0, v))
        size = random.integers(8, 48, 2)
        texture[a : a + size[0], b : b + size[1]] = random.integers(0, 256)
    return texture


def trajectory(frames: int) -> list[np.ndarray]:
    """Return camera poses (4, 4) once around the room: an ellipse, looking ahead and outwards; it ends where it began."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, frames, endpoint=False):
        at = np.array([1.4 * np.cos(angle), 0.9 * np.sin(angle), 0.15 * np.sin(2 * angle)])
        yaw = angle + 0.6
        forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([right, [0.0, 0.0, -1.0], forward])
        pose[:3, 3] = at
        poses.append(pose)
    return poses
