"""LiDAR odometry: registers each scan to the one before, for real, and checks the motion against the truth.

The scans are made here, from a seed: a 64-beam sensor drives through a hall with a floor, walls, boxes and pillars, and
each ray's range is computed and given noise. One request is one scan registered (down-sampling, covariances, GICP) with
small_gicp on all CPUs that the process may use. A registration that misses the true motion is a failed request,
however fast it was.
"""

import argparse
import math
import os
import signal
import sys

import fogspec_probe
import numpy as np
import small_gicp

BEAMS, COLUMNS, RANGE_M = 64, 1024, 60.0
RESOLUTION_M = 0.2
DRIFT_M, DRIFT_DEG = 0.02, 0.2  # what one registration may miss the true motion of 0.2 m by


class Hall:
    """Axis-aligned boxes (walls among them), vertical pillars, and a floor at z = 0."""

    def __init__(self, random: np.random.Generator) -> None:
        walls = [(-30, -20, 0, -29, 20, 8), (29, -20, 0, 30, 20, 8), (-30, -20, 0, 30, -19, 8), (-30, 19, 0, 30, 20, 8)]
        low = np.column_stack([random.uniform(-26, 24, 24), random.uniform(-16, 13, 24), np.zeros(24)])
        low = low[np.abs(low[:, 1] + 1) > 4]  # the aisle stays free
        high = low + np.column_stack([random.uniform(0.5, 4, len(low)), random.uniform(0.5, 3, len(low)),
                                      random.uniform(0.5, 4, len(low))])  # fmt: skip
        self.low = np.vstack([np.array(walls, float)[:, :3], low])
        self.high = np.vstack([np.array(walls, float)[:, 3:], high])
        self.pillars = np.column_stack(
            [np.repeat(np.arange(-24, 25, 8.0), 2), np.tile([-4.5, 4.5], 7), np.full(14, 0.3)]
        )

    def ranges(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Distance along each ray (n, 3) to what it meets first, infinite where it meets nothing."""
        with np.errstate(divide="ignore", invalid="ignore"):
            nearest = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
            for low, high in zip(self.low, self.high, strict=True):
                near, far = (low - origin) / rays, (high - origin) / rays
                enter = np.minimum(near, far).max(axis=1)
                leave = np.maximum(near, far).min(axis=1)
                nearest = np.where((enter <= leave) & (enter > 0), np.minimum(nearest, enter), nearest)
            flat = (rays[:, :2] ** 2).sum(axis=1)
            for x, y, radius in self.pillars:
                away = origin[:2] - (x, y)
                along = rays[:, :2] @ away
                under = along**2 - flat * (away @ away - radius**2)
                hit = (-along - np.sqrt(under)) / flat
                nearest = np.where((under > 0) & (hit > 0), np.minimum(nearest, hit), nearest)
        return nearest


def poses(count: int) -> list[np.ndarray]:
    """A drive along the aisle with a gentle weave: 4x4 poses of the sensor, 0.2 m apart."""
    found = []
    for i in range(count):
        x, yaw = -10 + 0.2 * i, 0.15 * math.sin(0.3 * i)
        pose = np.eye(4)
        pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        pose[:3, 3] = x, -0.5 + 0.3 * math.sin(0.2 * i), 1.5
        found.append(pose)
    return found


def scan(hall: Hall, pose: np.ndarray, noise_m: float, random: np.random.Generator) -> np.ndarray:
    """One sweep as points (n, 3) in the sensor's frame; ranges have noise of standard deviation `noise_m`."""
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-22, 10, BEAMS)), np.arange(COLUMNS) * 2 * np.pi / COLUMNS)
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    rays = rays.reshape(-1, 3)
    turned = rays @ pose[:3, :3].T
    # A few rays at once stay in a core's own cache.
    ranges = np.concatenate([hall.ranges(pose[:3, 3], part) for part in np.array_split(turned, 32)])
    seen = ranges < RANGE_M
    return np.asarray(rays[seen] * (ranges[seen] + noise_m * random.standard_normal(int(seen.sum())))[:, None])


def drift(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """How far an estimated motion is from the true one: metres and degrees."""
    error = np.linalg.inv(truth) @ estimate
    cosine = min(1.0, max(-1.0, (np.trace(error[:3, :3]) - 1) / 2))
    return float(np.linalg.norm(error[:3, 3])), math.degrees(math.acos(cosine))


def main() -> None:
    """Register scans, there and back along the drive, until stopped or until so many requests are done."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--scans", type=int, default=10)
    parser.add_argument("--noise", type=float, default=0.01, help="standard deviation of a range, metres")
    parser.add_argument("--requests", type=int, help="stop after so many; else go on until interrupted")
    options = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit(0))
    random = np.random.default_rng(options.seed)
    threads = len(os.sched_getaffinity(0))
    hall, truth = Hall(random), poses(options.scans)
    scans = [scan(hall, pose, options.noise, random) for pose in truth]
    print(f"{len(scans)} scans of about {len(scans[0])} points, {threads} threads", flush=True)

    round_trip = [*range(options.scans), *range(options.scans - 2, 0, -1)]
    before, before_at = small_gicp.preprocess_points(scans[0], RESOLUTION_M, num_threads=threads), 0
    done = 0
    while options.requests is None or done < options.requests:
        at = round_trip[(done + 1) % len(round_trip)]
        fogspec_probe.start("scan")
        now = small_gicp.preprocess_points(scans[at], RESOLUTION_M, num_threads=threads)
        result = small_gicp.align(before[0], now[0], before[1], num_threads=threads)
        metres, degrees = drift(result.T_target_source, np.linalg.inv(truth[before_at]) @ truth[at])
        good = result.converged and metres <= DRIFT_M and degrees <= DRIFT_DEG
        reason = None if good else f"drift of {metres:.3f} m, {degrees:.2f} degrees"
        fogspec_probe.stop("scan", ok=bool(good), reason=reason, drift_m=metres)
        before, before_at = now, at
        done += 1


if __name__ == "__main__":
    main()
