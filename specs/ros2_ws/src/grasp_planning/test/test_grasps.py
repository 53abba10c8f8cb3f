"""Grasps are on objects and antipodal; the network has the shape that it says."""

import numpy as np
from grasp_planning.grasps import Edges, plan
from grasp_planning.network import CROP, Network
from grasp_planning.scene import TABLE_M, depth_image


def test_grasps_are_antipodal_and_the_best_is_first():
    random = np.random.default_rng(3)
    depth, network = depth_image(random), Network(7)
    found = plan(depth, network, 8, random)
    assert found
    assert [one.quality for one in found] == sorted((one.quality for one in found), reverse=True)
    edges = Edges(depth)
    assert all(edges.antipodal(np.array([one.x, one.y, one.angle])) for one in found)
    assert np.mean([one.depth_m < TABLE_M - 0.005 for one in found]) > 0.9


def test_an_empty_table_has_no_grasp():
    random = np.random.default_rng(3)
    assert plan(depth_image(random, objects=0), Network(7), 8, random) == []


def test_the_network_is_the_same_for_a_seed():
    random = np.random.default_rng(5)
    crops, depths = random.random((3, CROP, CROP), np.float32), random.random(3, np.float32)
    one, two = (Network(seed).qualities(crops, depths) for seed in (7, 7))
    assert np.array_equal(one, two)
    assert not np.array_equal(one, Network(8).qualities(crops, depths))
    assert ((one > 0) & (one < 1)).all()
