"""The robot: sends the frames of a synthetic sequence, the next one when the pose of the last one is there.

The sequence goes around a room again and again. How far each pose is from the truth is published on `/slam/drift`
(std_msgs/Float64, metres).
"""

import contextlib

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from visual_slam.messages import image_message
from visual_slam.pose_graph import inverse
from visual_slam.world import Room, trajectory

LOST_S = 5.0  # a pose that takes longer is not waited for


class Client(Node):
    """One frame at a time."""

    def __init__(self) -> None:
        super().__init__("rgbd_camera")
        frames = self.declare_parameter("frames", 120).value
        seed = self.declare_parameter("seed", 7).value
        room, self.poses = Room(seed), trajectory(frames)
        self.frames = [tuple(image_message(image) for image in room.view(pose)) for pose in self.poses]
        origin = inverse(self.poses[0])
        self.truth = [(origin @ pose)[:3, 3] for pose in self.poses]  # in the map, which begins with the first frame
        self.sent: tuple[int, int] | None = None
        self.next, self.sent_s = 0, -LOST_S
        self.color = self.create_publisher(Image, "camera/color/image", 10)
        self.depth = self.create_publisher(Image, "camera/depth/image", 10)
        self.drift = self.create_publisher(Float64, "slam/drift", 10)
        self.create_subscription(PoseWithCovarianceStamped, "slam/pose", self.answered, 10)
        self.create_timer(0.2, self.tick)
        self.get_logger().info(f"{frames} frames around the room are ready")

    def answered(self, message: PoseWithCovarianceStamped) -> None:
        """Publish how far the pose is from the truth, and send the next frame."""
        if (message.header.stamp.sec, message.header.stamp.nanosec) != self.sent:
            return
        at = message.pose.pose.position
        truth = self.truth[(self.next - 1) % len(self.frames)]
        self.drift.publish(Float64(data=float(np.linalg.norm([at.x, at.y, at.z] - truth))))
        self.send()

    def tick(self) -> None:
        """Send the first frame once SLAM listens, and go on after a frame that was lost."""
        waiting = self.now_s() - self.sent_s < LOST_S
        ready = self.color.get_subscription_count() and self.depth.get_subscription_count()
        if not waiting and ready and self.count_publishers("slam/pose"):
            self.send()

    def now_s(self) -> float:
        """Return the node's clock in seconds."""
        return self.get_clock().now().nanoseconds / 1e9

    def send(self) -> None:
        """Publish one frame."""
        stamp = self.get_clock().now().to_msg()
        for message in self.frames[self.next % len(self.frames)]:
            message.header.stamp, message.header.frame_id = stamp, "camera"
        color, depth = self.frames[self.next % len(self.frames)]
        self.next, self.sent_s, self.sent = self.next + 1, self.now_s(), (stamp.sec, stamp.nanosec)
        self.depth.publish(depth)
        self.color.publish(color)


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Client())
