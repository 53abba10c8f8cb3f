"""Paths are free of collisions, and as long as they say."""

import numpy as np
import pytest
from motion_planning.portfolio import length_m, plan
from motion_planning.scenes import SCENES
from ompl import geometric as og
from ompl import util as ou

# A planner that finds a path at random finds it each time.
ou.RNG.setSeed(1)


@pytest.mark.parametrize("name", SCENES)
def test_both_ends_of_a_scene_are_free(name):
    scene = SCENES[name]()
    assert scene.free(scene.start)
    assert scene.free(scene.goal)
    middle = (scene.low[0] + scene.high[0]) / 2
    assert not scene.free(np.array([*middle, 1, 0, 0, 0]))


def test_a_path_is_free_and_joins_its_ends():
    scene = SCENES["apartment"]()
    path = plan(scene, og.BITstar, scene.start, scene.goal, 6000)
    assert path is not None
    assert all(scene.free(pose) for pose in path)
    assert np.allclose(path[0, :3], scene.start[:3])
    assert np.linalg.norm(path[-1, :3] - scene.goal[:3]) < 0.01
    assert length_m(path) >= np.linalg.norm(scene.goal[:3] - scene.start[:3])


def test_without_work_there_is_no_path():
    scene = SCENES["cubicles"]()
    assert plan(scene, og.RRTstar, scene.start, scene.goal, 1) is None
