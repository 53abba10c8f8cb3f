"""Synthetic depth images: a camera looks down on boxes and cylinders that lie on a table."""

import numpy as np

WIDTH, HEIGHT = 256, 192
METRES_PER_PIXEL = 0.002
TABLE_M = 0.70  # from the camera
NOISE_M = 0.0005


def depth_image(random: np.random.Generator, objects: int = 6) -> np.ndarray:
    """Return depths in metres (h, w) float32, as an orthographic camera sees them."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] * METRES_PER_PIXEL
    depth = np.full((HEIGHT, WIDTH), TABLE_M)
    for _ in range(objects):
        at = random.uniform([0.06, 0.06], [WIDTH * METRES_PER_PIXEL - 0.06, HEIGHT * METRES_PER_PIXEL - 0.06])
        turn, height = random.uniform(0, np.pi), random.uniform(0.02, 0.06)
        along = (x - at[0]) * np.cos(turn) + (y - at[1]) * np.sin(turn)
        across = -(x - at[0]) * np.sin(turn) + (y - at[1]) * np.cos(turn)
        if random.random() < 0.5:
            inside = (abs(along) < random.uniform(0.02, 0.05)) & (abs(across) < random.uniform(0.01, 0.025))
            top = np.full_like(depth, TABLE_M - height)
        else:
            radius = random.uniform(0.012, 0.025)
            inside = (abs(along) < random.uniform(0.03, 0.06)) & (abs(across) < radius)
            top = TABLE_M - radius - np.sqrt(np.maximum(radius**2 - across**2, 0))
        depth = np.where(inside, np.minimum(depth, top), depth)
    return (depth + random.normal(0, NOISE_M, depth.shape)).astype(np.float32)
