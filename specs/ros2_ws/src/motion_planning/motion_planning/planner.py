"""The node: hears a start and a goal pose, answers with the shortest path that its portfolio of planners finds.

`/plan_request` (geometry_msgs/PoseArray: start and goal) to `/motion_plan` (nav_msgs/Path, without poses if there is no path);
the length of the path is published on `/motion_plan/length` (std_msgs/Float64, metres).
"""

import numpy as np
import rclpy
from geometry_msgs.msg import Pose, PoseArray, PoseStamped
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Float64

from motion_planning.portfolio import Portfolio, length_m
from motion_planning.scenes import SCENES


class Planner(Node):
    """One scene, and a portfolio that plans in it."""

    def __init__(self) -> None:
        super().__init__("motion_planner")
        scene = self.declare_parameter("scene", "cubicles").value
        planners = self.declare_parameter("planners", 4).value
        checks = self.declare_parameter("checks", 15000).value
        seed = self.declare_parameter("seed", 7).value
        if scene not in SCENES:
            raise ValueError(f"there is no scene {scene}: it is one of {', '.join(SCENES)}")
        self.portfolio = Portfolio(scene, planners, checks, seed)
        self.path = self.create_publisher(Path, "motion_plan", 10)
        self.length = self.create_publisher(Float64, "motion_plan/length", 10)
        self.create_subscription(PoseArray, "plan_request", self.plan, 10)
        self.get_logger().info(f"{scene}: {planners} planners, {checks} collision checks each")

    def plan(self, request: PoseArray) -> None:
        """Answer one request."""
        answer = Path(header=request.header)
        if len(request.poses) != 2:
            self.get_logger().error(f"a request has two poses, start and goal, not {len(request.poses)}")
            self.path.publish(answer)
            return
        found = self.portfolio.plan(*(_array(pose) for pose in request.poses))
        if found is not None:
            answer.poses = [PoseStamped(header=request.header, pose=_message(pose)) for pose in found]
            self.length.publish(Float64(data=length_m(found)))
        self.path.publish(answer)


def _array(pose: Pose) -> np.ndarray:
    at, turn = pose.position, pose.orientation
    return np.array([at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z])


def _message(pose: np.ndarray) -> Pose:
    made = Pose()
    made.position.x, made.position.y, made.position.z = map(float, pose[:3])
    turn = made.orientation
    turn.w, turn.x, turn.y, turn.z = map(float, pose[3:])
    return made


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    node = Planner()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.portfolio.close()
