"""A node that declares the parameter `work`: at once, after a while, or not at all and allows every one.

parameters.py now|late|allows
"""

import contextlib
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException

kind = sys.argv[1]
rclpy.init()
node = rclpy.create_node("declares", allow_undeclared_parameters=kind == "allows")
if kind == "late":
    until_s = time.monotonic() + 3
    while time.monotonic() < until_s:
        rclpy.spin_once(node, timeout_sec=0.1)
if kind != "allows":
    node.declare_parameter("work", 1)
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
