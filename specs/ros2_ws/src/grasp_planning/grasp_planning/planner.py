"""The node: hears a depth image, answers with grasps, the best first.

`/depth_image` (sensor_msgs/Image, 32FC1, metres) to `/grasps` (geometry_msgs/PoseArray in the camera's frame; no pose if
nothing can be grasped).
"""

import contextlib

import numpy as np
import rclpy
from geometry_msgs.msg import Pose, PoseArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image

from grasp_planning.grasps import Grasp, plan
from grasp_planning.network import Network
from grasp_planning.scene import METRES_PER_PIXEL

BEST = 10


class Planner(Node):
    """The network, and what it has to be told."""

    def __init__(self) -> None:
        super().__init__("grasp_planner")
        self.samples = self.declare_parameter("samples", 64).value
        seed = self.declare_parameter("seed", 7).value
        self.random, self.network = np.random.default_rng(seed), Network(seed)
        self.grasps = self.create_publisher(PoseArray, "grasps", 10)
        self.create_subscription(Image, "depth_image", self.plan, 10)
        self.get_logger().info(f"{self.network.provider}, weights from seed {seed}: not trained")

    def plan(self, message: Image) -> None:
        """Answer one image."""
        depth = np.frombuffer(message.data, np.float32).reshape(message.height, message.width)
        found = plan(depth, self.network, self.samples, self.random)
        self.grasps.publish(PoseArray(header=message.header, poses=[_pose(one) for one in found[:BEST]]))


def _pose(grasp: Grasp) -> Pose:
    made = Pose()
    made.position.x, made.position.y = grasp.x * METRES_PER_PIXEL, grasp.y * METRES_PER_PIXEL
    made.position.z = grasp.depth_m
    made.orientation.z, made.orientation.w = float(np.sin(grasp.angle / 2)), float(np.cos(grasp.angle / 2))
    return made


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Planner())
