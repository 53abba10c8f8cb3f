"""A portfolio of OMPL's planners, each in a process of its own: the shortest of their paths is the answer.

OMPL's Python bindings have no parallel planner. A portfolio does a fixed amount of work, counted in poses that are checked for
collision, and so takes less time on more CPUs until there is one for each planner.
"""

import math
import multiprocessing
import os
import signal
from multiprocessing.pool import Pool

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from motion_planning.scenes import SCENES, Scene

PLANNERS = (og.BITstar, og.RRTstar)
RANGE_M = 2.0  # of one extension of RRT*: what passes a door
LONGEST_S = 60.0  # against a planner that checks nothing any more


class Portfolio:
    """Workers for one scene, as many as there are CPUs, at most one for each planner."""

    def __init__(self, scene: str, planners: int, checks: int, seed: int) -> None:
        """`checks` is the work of each planner."""
        self.scene, self.planners, self.checks = scene, planners, checks
        workers = min(planners, len(os.sched_getaffinity(0)))
        self._pool: Pool = multiprocessing.get_context("spawn").Pool(workers, _begin, (seed,))

    def plan(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """Return the shortest path (n, 7) that any planner found, None if none did."""
        tasks = [(self.scene, number, start, goal, self.checks) for number in range(self.planners)]
        found = [path for path in self._pool.map(_plan, tasks, chunksize=1) if path is not None]
        return min(found, key=length_m) if found else None

    def close(self) -> None:
        """End the workers."""
        self._pool.terminate()
        self._pool.join()


def length_m(path: np.ndarray) -> float:
    """Return how far the body's origin moves along a path (n, 7)."""
    return float(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).sum())


def _begin(seed: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the node ends its workers
    ou.setLogLevel(ou.LOG_ERROR)
    number = multiprocessing.current_process()._identity[-1]
    ou.RNG.setSeed(seed + number)


def _plan(task: tuple[str, int, np.ndarray, np.ndarray, int]) -> np.ndarray | None:
    name, number, start, goal, checks = task
    return plan(SCENES[name](), PLANNERS[number % len(PLANNERS)], start, goal, checks)


def plan(scene: Scene, planner: type, start: np.ndarray, goal: np.ndarray, checks: int) -> np.ndarray | None:
    """Return the path (n, 7) of one planner after so many collision checks; None without one."""
    space = ob.SE3StateSpace()
    bounds = ob.RealVectorBounds(3)
    for axis, size in enumerate(scene.size):
        bounds.setLow(axis, 0.0)
        bounds.setHigh(axis, float(size))
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    done = 0

    def valid(state: ob.SE3State) -> bool:
        nonlocal done
        done += 1
        return scene.free(_pose(state))

    setup.setStateValidityChecker(valid)
    setup.setStartAndGoalStates(_state(space, start), _state(space, goal), 1e-3)
    setup.setOptimizationObjective(ob.PathLengthOptimizationObjective(setup.getSpaceInformation()))
    one = planner(setup.getSpaceInformation())
    if isinstance(one, og.RRTstar):
        one.setRange(RANGE_M)
    setup.setPlanner(one)
    enough = ob.PlannerTerminationCondition(lambda: done >= checks)
    late = ob.timedPlannerTerminationCondition(LONGEST_S)
    setup.solve(ob.plannerOrTerminationCondition(enough, late))
    if not setup.haveExactSolutionPath():
        return None
    path = np.array([_pose(state) for state in setup.getSolutionPath().getStates()])
    return path if math.isfinite(length_m(path)) else None


def _pose(state: ob.SE3State) -> np.ndarray:
    turn = state.rotation()
    return np.array([state.getX(), state.getY(), state.getZ(), turn.w, turn.x, turn.y, turn.z])


def _state(space: ob.SE3StateSpace, pose: np.ndarray) -> ob.SE3State:
    state = space.allocState()
    state.setXYZ(*map(float, pose[:3]))
    turn = state.rotation()
    turn.w, turn.x, turn.y, turn.z = map(float, pose[3:])
    return state
