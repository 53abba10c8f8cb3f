"""A node that does not answer, for a reason that its graph or its output shows: silent.py KIND."""

import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu
from std_msgs.msg import String

kind = sys.argv[1]
rclpy.init()
node = LifecycleNode("planner") if kind == "inactive" else rclpy.create_node("planner")


def take(message):
    if kind == "extrapolation":
        node.get_logger().warning("Lookup would require extrapolation into the past. Requested time 9.5")


if kind == "inactive":
    node.on_configure = lambda _state: TransitionCallbackReturn.SUCCESS
elif kind == "map":
    answers = node.create_publisher(PoseStamped, "/pose", 10)
    node.create_subscription(Imu, "/imu", take, 10)
    volatile = node.create_publisher(String, "/map", 10)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(String, "/map", take, latched)
elif kind == "elsewhere":
    answers = node.create_publisher(PoseStamped, "/pose", 10)
    node.create_subscription(Imu, "/imu_raw", take, 10)
else:
    answers = node.create_publisher(PoseStamped, "/pose", 10)
    node.create_subscription(Imu, "/imu", take, 10)
rclpy.spin(node)
