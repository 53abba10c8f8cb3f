"""The node: hears colour and depth images with one stamp, answers with the camera's pose in the map.

`/camera/color/image` (sensor_msgs/Image, mono8) and `/camera/depth/image` (32FC1, metres) to `/slam/pose`
(geometry_msgs/PoseWithCovarianceStamped). The first camera pose is the map's origin. The variance of a lost frame is LOST_M2.
"""

import contextlib
import os

import cv2
import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image

from visual_slam.messages import image_of, pose_message
from visual_slam.tracking import Slam
from visual_slam.world import CAMERA, FOCAL_PX

LOST_M2 = 1e6
TYPICAL_DEPTH_M = 3.0


class SlamNode(Node):
    """Waits for both images of a frame, then tracks it."""

    def __init__(self) -> None:
        super().__init__("slam")
        threads = self.declare_parameter("threads", len(os.sched_getaffinity(0))).value
        seed = self.declare_parameter("seed", 7).value
        cv2.setNumThreads(threads)
        self.slam = Slam(CAMERA, threads, seed)
        self.depths: dict[tuple[int, int], np.ndarray] = {}
        self.images: dict[tuple[int, int], Image] = {}
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "slam/pose", 10)
        self.create_subscription(Image, "camera/color/image", self.color, 10)
        self.create_subscription(Image, "camera/depth/image", self.depth, 10)

    def color(self, message: Image) -> None:
        """Take the colour image of a frame."""
        self.images = {_stamp(message): message}
        self.together(_stamp(message))

    def depth(self, message: Image) -> None:
        """Take the depth image of a frame."""
        self.depths = {_stamp(message): image_of(message)}
        self.together(_stamp(message))

    def together(self, stamp: tuple[int, int]) -> None:
        """Answer a frame once it is whole."""
        if stamp not in self.images or stamp not in self.depths:
            return
        message = self.images.pop(stamp)
        found = self.slam.track(image_of(message), self.depths.pop(stamp))
        answer = PoseWithCovarianceStamped(header=message.header)
        answer.header.frame_id = "map"
        answer.pose.pose = pose_message(found.pose)
        # What an error of the features in the image means at a typical distance, averaged over the features.
        error_m = max(found.error_px, 0.5) / FOCAL_PX * TYPICAL_DEPTH_M
        variance = LOST_M2 if found.lost else error_m**2 / found.inliers
        covariance = np.zeros(36)
        covariance[[0, 7, 14]] = variance
        answer.pose.covariance = covariance
        self.poses.publish(answer)


def _stamp(message: Image) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(SlamNode())
