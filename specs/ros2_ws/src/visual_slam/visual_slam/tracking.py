"""Visual odometry with ORB features on RGB-D frames, and loops that close a pose graph of keyframes."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from visual_slam.pose_graph import PoseGraph, inverse

FEATURES = 2000
NEIGHBOURS = 4  # keyframes that a frame is matched with
RATIO = 0.8  # Lowe's test
LEAST_INLIERS = 30
NEW_KEYFRAME_M, NEW_KEYFRAME_RAD = 0.25, 0.2
LOOP_M, LOOP_RAD, LOOP_APART = 0.8, 0.6, 10


@dataclass
class Keyframe:
    """Descriptors (n, 32) of features and where they are in the camera's frame (n, 3), metres."""

    descriptors: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class Tracked:
    """The pose of a frame (4, 4), the features it rests on, and their median error in pixels."""

    pose: np.ndarray
    inliers: int
    error_px: float

    @property
    def lost(self) -> bool:
        """Whether too little was recognised."""
        return self.inliers < LEAST_INLIERS


class Slam:
    """Track one frame after the other. OpenCV works outside Python's lock, so threads match on several CPUs."""

    def __init__(self, camera: np.ndarray, threads: int, seed: int) -> None:
        self.camera, self.graph = camera, PoseGraph()
        self.keyframes: list[Keyframe] = []
        self.loops = 0
        self._pose = np.eye(4)
        self._orb = cv2.ORB_create(FEATURES)
        self._threads = ThreadPoolExecutor(threads)
        cv2.setRNGSeed(seed)

    def track(self, image: np.ndarray, depth: np.ndarray) -> Tracked:
        """Return the pose of a grey image (h, w) with its depth (h, w) in metres."""
        found, descriptors = self._orb.detectAndCompute(image, None)
        pixels = np.array([one.pt for one in found]).reshape(-1, 2)
        if not self.keyframes:
            self._keep(descriptors, pixels, depth, [])
            return Tracked(self._pose, len(pixels), 0.0)
        near = self._near()
        seen = [one for one in self._threads.map(lambda key: self._against(key, descriptors, pixels), near) if one]
        if not seen:
            return Tracked(self._pose, 0, float("inf"))
        key, relative, inliers, error = max(seen, key=lambda one: one[2])
        self._pose = self.graph.poses[key] @ relative
        away = np.linalg.norm(relative[:3, 3])
        turned = np.linalg.norm(cv2.Rodrigues(relative[:3, :3])[0])
        if away > NEW_KEYFRAME_M or turned > NEW_KEYFRAME_RAD:
            self._keep(descriptors, pixels, depth, seen)
        return Tracked(self._pose, inliers, error)

    def _near(self) -> list[int]:
        """Return the latest keyframes, and others that look at the same place: a loop that may be closed."""
        last = len(self.keyframes) - 1
        latest = list(range(max(0, last - NEIGHBOURS // 2 + 1), last + 1))
        old = []
        for i in range(last - LOOP_APART):
            relative = inverse(self.graph.poses[i]) @ self._pose
            turned = np.linalg.norm(cv2.Rodrigues(relative[:3, :3])[0])
            away = np.linalg.norm(relative[:3, 3])
            if away < LOOP_M and turned < LOOP_RAD:
                old.append((away + turned, i))
        return latest + [i for _, i in sorted(old)[: NEIGHBOURS - len(latest)]]

    def _against(
        self, key: int, descriptors: np.ndarray, pixels: np.ndarray
    ) -> tuple[int, np.ndarray, int, float] | None:
        """Return the camera's pose in a keyframe with its inliers and their median error; None if it is not recognised."""
        frame = self.keyframes[key]
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors, frame.descriptors, k=2)
        good = [a for a, *b in pairs if b and a.distance < RATIO * b[0].distance]
        if len(good) < LEAST_INLIERS:
            return None
        points = frame.points[[one.trainIdx for one in good]]
        at = pixels[[one.queryIdx for one in good]]
        try:
            ok, turn, move, inliers = cv2.solvePnPRansac(
                points, at, self.camera, None, iterationsCount=200, reprojectionError=2.0, flags=cv2.SOLVEPNP_SQPNP
            )
        except cv2.error:  # the drawn points are all at one place
            return None
        if not ok or inliers is None or len(inliers) < LEAST_INLIERS:
            return None
        points, at = points[inliers[:, 0]], at[inliers[:, 0]]
        turn, move = cv2.solvePnPRefineLM(points, at, self.camera, None, turn, move)
        again, _ = cv2.projectPoints(points, turn, move, self.camera, None)
        error = float(np.median(np.linalg.norm(again[:, 0] - at, axis=1)))
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], move[:, 0]
        return key, inverse(motion), len(inliers), error

    def _keep(
        self,
        descriptors: np.ndarray,
        pixels: np.ndarray,
        depth: np.ndarray,
        seen: list[tuple[int, np.ndarray, int, float]],
    ) -> None:
        """Make the frame a keyframe, tied to those in which it was recognised; a tie to an old one closes a loop."""
        columns, rows = pixels.astype(int).T
        z = depth[rows, columns]
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(self.camera).T
        has_depth = z > 0
        new = len(self.keyframes)
        self.keyframes.append(Keyframe(descriptors[has_depth], (rays * z[:, None])[has_depth]))
        self.graph.poses.append(self._pose)
        self.graph.edges += [(key, new, relative, float(inliers)) for key, relative, inliers, _ in seen]
        if any(new - key > LOOP_APART for key, *_ in seen):
            self.loops += 1
            self.graph.optimise()
            self._pose = self.graph.poses[new]
