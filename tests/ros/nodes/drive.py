"""Answers /imu as nodes do that need what a robot records beside it: drive.py KIND.

`frames`: where another topic has a stamp close to it, in a message of several. `timer`: from a timer of the node's clock, 20
times a second. `map`: once it has the map, which was published once, before it started.
"""

import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import Imu
from std_msgs.msg import String

CLOSE_NS = 100_000_000
kind = sys.argv[1]
rclpy.init(args=sys.argv)
node = rclpy.create_node("drive")
known = {"frames": 0, "map": "", "latest": None}
out = node.create_publisher(PoseStamped, "/pose", 10)


def moved(message):
    known["frames"] = max(Time.from_msg(one.header.stamp).nanoseconds for one in message.poses)


def answer(message):
    at = Time.from_msg(message.header.stamp).nanoseconds
    if kind == "timer":
        known["latest"] = message
    elif (abs(at - known["frames"]) <= CLOSE_NS) if kind == "frames" else known["map"] == "all":
        out.publish(PoseStamped(header=message.header))


def tick():
    # By a clock that is not that of the stamps, all of them are too old, or not there yet.
    if (latest := known["latest"]) is not None:
        age = node.get_clock().now().nanoseconds - Time.from_msg(latest.header.stamp).nanoseconds
        known["latest"] = None
        if -CLOSE_NS < age < 10 * CLOSE_NS:
            out.publish(PoseStamped(header=latest.header))


node.create_subscription(Imu, "/imu", answer, qos_profile_sensor_data)
if kind == "frames":
    node.create_subscription(Path, "/frames", moved, 100)
elif kind == "timer":
    node.create_timer(0.05, tick)
else:
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(String, "/map", lambda message: known.update(map=message.data), latched)
rclpy.spin(node)
