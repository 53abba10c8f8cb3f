"""The robot: asks for a plan through the scene, and for the next one when it has the answer."""

import contextlib

import rclpy
from geometry_msgs.msg import Pose, PoseArray
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from motion_planning.scenes import SCENES

LOST_S = 60.0  # an answer that takes longer is not waited for


class Client(Node):
    """One request at a time, from start to goal and back."""

    def __init__(self) -> None:
        super().__init__("motion_planning_client")
        scene = SCENES[self.declare_parameter("scene", "cubicles").value]()
        self.ends = [scene.start, scene.goal]
        self.sent_s: float | None = None
        self.requests = self.create_publisher(PoseArray, "plan_request", 10)
        self.create_subscription(Path, "motion_plan", self.answered, 10)
        self.create_timer(0.2, self.tick)

    def answered(self, _: Path) -> None:
        """Turn round."""
        self.ends.reverse()
        self.send()

    def tick(self) -> None:
        """Send the first request once the planner listens, and another one in place of one that was lost."""
        waiting = self.sent_s is not None and self.now_s() - self.sent_s < LOST_S
        if not waiting and self.requests.get_subscription_count() and self.count_publishers("motion_plan"):
            self.send()

    def now_s(self) -> float:
        """Return the node's clock in seconds."""
        return self.get_clock().now().nanoseconds / 1e9

    def send(self) -> None:
        """Ask for a plan between the two ends."""
        message = PoseArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "map"
        for x, y, z, w, *axis in self.ends:
            pose = Pose()
            pose.position.x, pose.position.y, pose.position.z = float(x), float(y), float(z)
            pose.orientation.w = float(w)
            pose.orientation.x, pose.orientation.y, pose.orientation.z = map(float, axis)
            message.poses.append(pose)
        self.sent_s = self.now_s()
        self.requests.publish(message)


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Client())
