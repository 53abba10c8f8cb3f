from itertools import product

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = [("rate", "30"), ("frame", "map"), ("debug", "false")]
CAMERAS = ["front", "rear"]


def generate_launch_description():
    ld = LaunchDescription([DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS])
    given = {name: LaunchConfiguration(name) for name, _ in ARGUMENTS}
    for index, name in enumerate(CAMERAS, start=1):
        ld.add_action(Node(package="demo_robot", executable="camera", name=f"camera_{name}",
                           parameters=[{"index": index, **given}, {"rate": 15} if index % 2 else {}]))
    for (side, kind), gain in zip(product(("left", "right"), ("arm", "leg")), (1.0, 2.0, 3.0, 4.0)):
        ld.add_action(Node(package="demo_robot", executable=kind, namespace=side, parameters=[{"gain": gain}]))
    count = 0
    while count < 3:
        count += 1
        if count == 2:
            continue
        ld.add_action(Node(package="demo_robot", executable="worker", name="worker" + str(count)))
    return ld
