"""Everything on one computer: the node and what it is tried with."""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """Return the node and its client."""
    return LaunchDescription(
        [
            Node(package="visual_slam", executable="slam"),
            Node(package="visual_slam", executable="client"),
        ]
    )
