"""Records topics into a bag, as `ros2 bag record` does: recorder.py FOLDER TOPIC=PACKAGE/msg/NAME [...]."""

import contextlib
import importlib
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
rclpy.init()
node = rclpy.create_node("recorder")
with Writer(sys.argv[1], version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    for word in sys.argv[2:]:
        topic, _, kind = word.partition("=")
        package, _, name = kind.rpartition("/")
        connection = writer.add_connection(topic, kind, typestore=store)
        message_type = getattr(importlib.import_module(package.replace("/", ".")), name)

        def received(data, connection=connection):
            writer.write(connection, time.time_ns(), data)

        node.create_subscription(message_type, topic, received, 100, raw=True)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
