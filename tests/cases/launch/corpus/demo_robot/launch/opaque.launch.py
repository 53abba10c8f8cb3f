from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def arm(name, *, speed=1.0, **words):
    return Node(package="demo_robot", executable="arm", name=name, parameters=[{"speed": speed, **words}])


def setup(context, *args, **kwargs):
    count = int(LaunchConfiguration("count").perform(context))
    with open(Path(get_package_share_directory("demo_robot")) / "config" / "planner.yaml") as file:
        rate = yaml.safe_load(file)["/**"]["ros__parameters"]["rate"]
    nodes = [arm(f"arm_{i:02d}", speed=rate * i, side="left" if i % 2 else "right") for i in range(count)]
    if context.launch_configurations["gripper"].lower() == "true":
        nodes.append(Node(package="demo_robot", executable="gripper", arguments=["{}".format(count), "--" + "x".join(["a", "b"])]))
    total = 0
    while total < 3:
        total += 1
    return nodes + [Node(package="demo_robot", executable="total", parameters=[{"total": total}])]


def generate_launch_description():
    ld = LaunchDescription()
    for name, default in {"count": "3", "gripper": "true"}.items():
        ld.add_action(DeclareLaunchArgument(name, default_value=default))
    ld.add_action(OpaqueFunction(function=setup))
    return ld
