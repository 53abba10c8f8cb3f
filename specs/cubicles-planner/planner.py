"""SE(3) motion planning with PRM*: an L-shaped body is moved through cubicles, for real, on all CPUs it may use.

The scene is a floor of rooms with narrow doors, like the Cubicles scene that is common in motion planning. One request
is one plan: a fresh roadmap from random poses (Karaman and Frazzoli, 2011: k = e(1 + 1/d) ln n neighbours), its
collision checks spread over worker processes, and the shortest path by Dijkstra. No path is a failed request. The
length of the path is a metric of the application. With `--planners`, a request is so many independent roadmaps instead,
each built by one process, and the shortest path of all.
"""

import argparse
import functools
import math
import multiprocessing
import os
import signal
import sys

import fogspec_probe
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

SIZE_M = np.array([20.0, 16.0, 3.0])
# An L of five spheres: centres in the body's frame and one radius.
BODY = np.array([[-0.6, 0, 0], [0, 0, 0], [0.6, 0, 0], [0.6, 0.45, 0], [0.6, 0.9, 0]])
RADIUS_M = 0.25
TURN_WEIGHT_M = 0.8  # how many metres half a turn counts as, in the roadmap's metric
CHECKS = 11  # poses checked on the way between two neighbours
BLOCK = 128  # edges checked at once: their poses stay in a core's own cache
DOOR_M = 2.6
START = np.array([1.5, 1.5, 1.5, 1, 0, 0, 0])
GOAL = np.array([18.5, 14.5, 1.5, 1, 0, 0, 0])


def cubicles() -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners (boxes, 3, 1) of partitions with doors, and of desks within the rooms."""
    boxes = []
    for x, doors in ((5.0, (2.0, 9.0)), (10.0, (6.0, 13.0)), (15.0, (3.0, 10.0))):
        edges = [0.0, *(edge for door in doors for edge in (door, door + DOOR_M)), SIZE_M[1]]
        boxes += [(x, a, 0, x + 0.2, b, 3) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    for y, doors in ((5.3, (2.5, 12.0)), (10.6, (7.0, 17.0))):
        edges = [0.0, *(edge for door in doors for edge in (door, door + DOOR_M)), SIZE_M[0]]
        boxes += [(a, y, 0, b, y + 0.2, 3) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    boxes += [(x, y, 0, x + 1.2, y + 0.8, 1.0) for x in (0.3, 6.0, 11.5, 16.5) for y in (3.6, 8.4, 12.4)]
    corners = np.array(boxes)
    return corners[:, :3, None].astype(np.float32), corners[:, 3:, None].astype(np.float32)


LOW, HIGH = cubicles()


def rotated(quaternions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Body points (p, 3) under unit quaternions (n, 4) w, x, y, z: (n, p, 3)."""
    w, v = quaternions[:, None, :1], quaternions[:, None, 1:]
    turned = 2 * np.cross(v, np.broadcast_to(points, (len(quaternions), *points.shape)))
    return np.asarray(points + w * turned + np.cross(v, turned))


def free(poses: np.ndarray) -> np.ndarray:
    """Which poses (n, 7) touch neither a wall nor the bounds."""
    centres = rotated(poses[:, 3:], BODY) + poses[:, None, :3]
    found = ((centres >= RADIUS_M) & (centres <= SIZE_M - RADIUS_M)).all(axis=(1, 2))
    # What leaves the bounds need not be held against the walls.
    points = centres[found].reshape(-1, 3).T.astype(np.float32)
    clear = np.ones(points.shape[1], bool)
    for low, high in zip(LOW, HIGH, strict=True):
        gap = np.maximum(np.maximum(low - points, points - high), 0)
        clear &= gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2 > RADIUS_M**2
    found[found] = clear.reshape(-1, len(BODY)).all(axis=1)
    return np.asarray(found)


def between(a: np.ndarray, b: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Poses on the way from a to b (n, 7) at the given shares (s,): (n, s, 7), the shorter turn."""
    sign = np.where((a[:, 3:] * b[:, 3:]).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    end = np.concatenate([b[:, :3], b[:, 3:] * sign], axis=1)
    way = a[:, None] + (end - a)[:, None] * shares[:, None]
    way[..., 3:] /= np.linalg.norm(way[..., 3:], axis=2, keepdims=True)
    return np.asarray(way)


def edges_free(pairs: np.ndarray) -> np.ndarray:
    """Which straight ways between two poses (n, 2, 7) are free at CHECKS poses between them."""
    shares = np.linspace(0, 1, CHECKS + 2)[1:-1]
    found = []
    for part in np.array_split(pairs, math.ceil(len(pairs) / BLOCK) or 1):
        way = between(part[:, 0], part[:, 1], shares)
        found.append(free(way.reshape(-1, 7)).reshape(-1, CHECKS).all(axis=1))
    return np.concatenate(found)


def random_poses(count: int, random: np.random.Generator) -> np.ndarray:
    """Uniform positions and orientations."""
    turns = random.standard_normal((count, 4))
    return np.column_stack(
        [random.uniform(0, SIZE_M, (count, 3)), turns / np.linalg.norm(turns, axis=1, keepdims=True)]
    )


def spread(pool: "multiprocessing.pool.Pool | None", check, items: np.ndarray, workers: int) -> np.ndarray:  # type: ignore[no-untyped-def]
    """`check` over all items (n, ...), on every worker."""
    if pool is None:
        return np.asarray(check(items))
    return np.concatenate(pool.map(check, np.array_split(items, 4 * workers)))


def plan(
    count: int, random: np.random.Generator, pool: "multiprocessing.pool.Pool | None", workers: int
) -> float | None:
    """Length in metres of the best path that a roadmap of `count` random poses has, None for no path."""
    poses = random_poses(count, random)
    nodes = np.vstack([START, GOAL, poses[spread(pool, free, poses, workers)]])
    # Opposite quaternions are one orientation: half of them are turned over, so that neighbours are near.
    nodes[nodes[:, 3] < 0, 3:] *= -1
    k = min(math.ceil(math.e * (1 + 1 / 6) * math.log(len(nodes))), len(nodes) - 1)
    metric = np.concatenate([nodes[:, :3], nodes[:, 3:] * TURN_WEIGHT_M], axis=1)
    _, near = cKDTree(metric).query(metric, k=k + 1, workers=workers)
    a, b = np.repeat(np.arange(len(nodes)), k), near[:, 1:].ravel()
    once = np.unique(np.sort(np.column_stack([a, b]), axis=1), axis=0)
    once = once[spread(pool, edges_free, nodes[once], workers)]
    weight = np.linalg.norm(metric[once[:, 0]] - metric[once[:, 1]], axis=1)
    roadmap = coo_array((weight, (once[:, 0], once[:, 1])), shape=(len(nodes),) * 2).tocsr()
    reached, before = dijkstra(roadmap, directed=False, indices=0, return_predecessors=True)
    if not math.isfinite(reached[1]):
        return None
    path = [1]
    while path[-1] != 0:
        path.append(int(before[path[-1]]))
    return float(np.linalg.norm(np.diff(nodes[path, :3], axis=0), axis=1).sum())


def alone(count: int, seeds: list[int]) -> float | None:
    """Length in metres of the path that one process finds on a roadmap of its own; None for no path."""
    return plan(count, np.random.default_rng(seeds), None, 1)


def portfolio(count: int, seeds: list[list[int]], pool: "multiprocessing.pool.Pool | None") -> float | None:
    """Length in metres of the shortest path of independent planners, a process a CPU; None if none finds one."""
    work = functools.partial(alone, count)
    found = [work(one) for one in seeds] if pool is None else pool.map(work, seeds, chunksize=1)
    return min((length_m for length_m in found if length_m is not None), default=None)


def main() -> None:
    """Plan again and again, until stopped or until so many requests are done."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--samples", type=int, default=6000, help="random poses of one roadmap")
    parser.add_argument("--planners", type=int, help="independent planners of a request, of which the best path counts")
    parser.add_argument("--requests", type=int, help="stop after so many; else go on until interrupted")
    options = parser.parse_args()
    workers = len(os.sched_getaffinity(0))
    # Whoever ends this program signals every process of it: the workers leave it to their parent to end them.
    with multiprocessing.get_context("fork").Pool(workers, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as made:
        pool = made if workers > 1 else None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: sys.exit(0))
        print(f"{len(LOW)} boxes, {workers} workers", flush=True)
        done = 0
        while options.requests is None or done < options.requests:
            random = np.random.default_rng([options.seed, done])
            fogspec_probe.start("plan")
            if options.planners is None:
                length_m = plan(options.samples, random, pool, workers)
            else:
                seeds = [[options.seed, done, number] for number in range(options.planners)]
                length_m = portfolio(options.samples, seeds, pool)
            if length_m is None:
                fogspec_probe.stop("plan", ok=False, reason="no path")
            else:
                fogspec_probe.stop("plan", path_length_m=length_m)
            done += 1


if __name__ == "__main__":
    main()
