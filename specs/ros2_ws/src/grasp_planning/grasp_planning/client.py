"""The robot: sends depth images of a table, the next one when it has grasps for the last one."""

import contextlib

import numpy as np
import rclpy
from geometry_msgs.msg import PoseArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image

from grasp_planning.scene import depth_image

LOST_S = 30.0  # an answer that takes longer is not waited for


class Client(Node):
    """One image at a time."""

    def __init__(self) -> None:
        super().__init__("depth_camera")
        self.random = np.random.default_rng(self.declare_parameter("seed", 7).value)
        self.sent_s = -LOST_S
        self.images = self.create_publisher(Image, "depth_image", 10)
        self.create_subscription(PoseArray, "grasps", self.answered, 10)
        self.create_timer(0.2, self.tick)

    def answered(self, _: PoseArray) -> None:
        """Send the next image."""
        self.send()

    def tick(self) -> None:
        """Send the first image once the planner listens, and another one in place of one that was lost."""
        waiting = self.now_s() - self.sent_s < LOST_S
        if not waiting and self.images.get_subscription_count() and self.count_publishers("grasps"):
            self.send()

    def now_s(self) -> float:
        """Return the node's clock in seconds."""
        return self.get_clock().now().nanoseconds / 1e9

    def send(self) -> None:
        """Publish the image of a new table."""
        depth = depth_image(self.random)
        height, width = depth.shape
        message = Image(height=height, width=width, encoding="32FC1", step=4 * width, data=depth.tobytes())
        message.header.frame_id = "camera"
        message.header.stamp = self.get_clock().now().to_msg()
        self.sent_s = self.now_s()
        self.images.publish(message)


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Client())
