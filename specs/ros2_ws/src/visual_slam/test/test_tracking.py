"""Poses against the known truth, and loops that take drift away."""

import numpy as np
from visual_slam.pose_graph import PoseGraph, exponential, inverse, tangent
from visual_slam.tracking import Slam
from visual_slam.world import CAMERA, Room, trajectory


def test_a_camera_is_tracked_and_a_view_without_features_is_lost():
    room, slam, poses = Room(7), Slam(CAMERA, 1, 7), trajectory(120)[:8]
    for pose in poses:
        found = slam.track(*room.view(pose))
        assert not found.lost
        assert np.linalg.norm((poses[0] @ found.pose)[:3, 3] - pose[:3, 3]) < 0.1
    image, depth = room.view(poses[0])
    assert slam.track(np.full_like(image, 90), depth).lost


def test_features_that_are_all_at_one_place_recognise_nothing():
    slam = Slam(CAMERA, 1, 7)
    slam.track(*Room(7).view(trajectory(120)[0]))
    key = slam.keyframes[0]
    key.points[:] = np.array([0.1, 0.2, 2.0]) + np.random.default_rng(1).normal(0, 1e-5, key.points.shape)
    seen = key.points @ CAMERA.T
    assert slam._against(0, key.descriptors, seen[:, :2] / seen[:, 2:]) is None


def test_the_depth_of_a_view_is_that_of_the_room():
    image, depth = Room(1).view(trajectory(4)[0])
    assert image.shape == depth.shape
    assert 0.5 < depth.min() < depth.max() < 8


def test_a_closed_loop_takes_the_drift_away():
    truth = [exponential(np.array([np.cos(a), np.sin(a), 0, 0, 0, a])) for a in np.linspace(0, 2, 12)]
    graph, random = PoseGraph([truth[0]]), np.random.default_rng(3)
    for i in range(1, 12):
        noise = exponential(random.normal(0, 0.02, 6))
        graph.edges.append((i - 1, i, inverse(truth[i - 1]) @ truth[i] @ noise, 100.0))
        graph.poses.append(graph.poses[-1] @ graph.edges[-1][2])
    before = np.linalg.norm(tangent(inverse(graph.poses[-1]) @ truth[-1]))
    graph.edges.append((0, 11, inverse(truth[0]) @ truth[11], 1e4))
    graph.optimise()
    assert np.linalg.norm(tangent(inverse(graph.poses[-1]) @ truth[-1])) < 0.1 * before
