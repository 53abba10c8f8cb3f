"""A managed node that answers while it is active: managed.py SEEN [--fails N] [--slow S]. SEEN gets a line of each transition.

`--fails`: so many times it cannot be configured. `--slow`: so long it takes.
"""

import argparse
import contextlib
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from sensor_msgs.msg import Imu

parser = argparse.ArgumentParser()
parser.add_argument("seen")
parser.add_argument("--fails", type=int, default=0)
parser.add_argument("--slow", type=float, default=0.0)
options, _ = parser.parse_known_args()


class Planner(LifecycleNode):
    """As one is written in C++: topics when it is configured, answers when it is active."""

    def __init__(self):
        super().__init__("planner")
        self.failures, self.is_active = 0, False

    def on_configure(self, state):
        self.failures += 1
        if self.failures <= options.fails:
            return self.note("failed", TransitionCallbackReturn.FAILURE)
        self.publisher = self.create_publisher(PoseStamped, "/pose", 10)
        self.subscription = self.create_subscription(Imu, "/imu", self.answer, 10)
        time.sleep(options.slow)
        return self.note("configured")

    def on_activate(self, state):
        self.is_active = True
        return self.note("active")

    def on_deactivate(self, state):
        self.is_active = False
        return self.note("inactive")

    def answer(self, message):
        if not self.is_active:
            self.note("lost")
            return
        self.publisher.publish(PoseStamped(header=message.header))

    def note(self, what, returned=TransitionCallbackReturn.SUCCESS):
        with open(options.seen, "a") as file:
            file.write(f"{self.get_fully_qualified_name()} {what}\n")
        return returned


rclpy.init(args=sys.argv)
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Planner())
