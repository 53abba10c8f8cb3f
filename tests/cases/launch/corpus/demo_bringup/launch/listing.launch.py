from fogros2 import SkyLaunchDescription
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    planner = Node(package="demo_robot", executable="planner", name="planner", parameters=[{"model": "small", "gain": 38.0}],
                   remappings=[("/image", "/camera/image")])
    sky = SkyLaunchDescription(nodes=[planner], max_latency=0.5, max_cost=0.01, min_cpu=2, max_cpu=64, alpha=0.7)
    client = Node(package="demo_robot", executable="client", namespace="arm")
    return LaunchDescription([sky, client])
