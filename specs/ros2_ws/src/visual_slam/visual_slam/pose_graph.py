"""A pose graph: relative poses between keyframes, and the poses that agree with them best (Gauss-Newton on SE(3))."""

from dataclasses import dataclass, field

import cv2
import numpy as np

ITERATIONS = 5


@dataclass
class PoseGraph:
    """Poses (4, 4) from the camera to the map, and edges (i, j, relative pose of j in i, weight); pose 0 is fixed."""

    poses: list[np.ndarray] = field(default_factory=list)
    edges: list[tuple[int, int, np.ndarray, float]] = field(default_factory=list)

    def optimise(self) -> None:
        """Move the poses so that the edges' errors are smallest, in the sense of least squares."""
        size = 6 * len(self.poses)
        for _ in range(ITERATIONS):
            matrix, right = np.zeros((size, size)), np.zeros(size)
            matrix[:6, :6] = np.eye(6) * 1e12
            for i, j, measured, weight in self.edges:
                error = tangent(inverse(measured) @ inverse(self.poses[i]) @ self.poses[j])
                # To first order, with steps on the right of each pose: d(error) = step_j - Ad(inverse of measured) step_i.
                moved = -adjoint(inverse(self.poses[j]) @ self.poses[i])
                a, b = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
                matrix[a, a] += weight * moved.T @ moved
                matrix[a, b] += weight * moved.T
                matrix[b, a] += weight * moved
                matrix[b, b] += weight * np.eye(6)
                right[a] -= weight * moved.T @ error
                right[b] -= weight * error
            steps = np.linalg.solve(matrix, right).reshape(-1, 6)
            self.poses = [pose @ exponential(step) for pose, step in zip(self.poses, steps, strict=True)]
            if np.abs(steps).max() < 1e-6:
                return


def inverse(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid motion (4, 4)."""
    made = np.eye(4)
    made[:3, :3] = pose[:3, :3].T
    made[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return made


def tangent(pose: np.ndarray) -> np.ndarray:
    """Return the translation and the rotation vector of a motion: its tangent vector (6,) to first order."""
    return np.concatenate([pose[:3, 3], cv2.Rodrigues(pose[:3, :3])[0].ravel()])


def exponential(step: np.ndarray) -> np.ndarray:
    """Return the motion (4, 4) of a tangent vector (6,), the inverse of `tangent`."""
    made = np.eye(4)
    made[:3, :3] = cv2.Rodrigues(step[3:])[0]
    made[:3, 3] = step[:3]
    return made


def adjoint(pose: np.ndarray) -> np.ndarray:
    """Return the adjoint matrix (6, 6) of a motion, for tangent vectors with the translation first."""
    turn, (x, y, z) = pose[:3, :3], pose[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    made = np.zeros((6, 6))
    made[:3, :3] = made[3:, 3:] = turn
    made[:3, 3:] = cross @ turn
    return made
