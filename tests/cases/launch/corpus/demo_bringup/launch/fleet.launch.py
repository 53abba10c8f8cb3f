import json

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, PushRosNamespace


def robots(context, *args, **kwargs):
    poses = json.loads(LaunchConfiguration("robots").perform(context))
    rate = float(context.launch_configurations["rate"])
    groups = []
    for name, (x, y) in sorted(poses.items()):
        groups.append(GroupAction([
            PushRosNamespace(name),
            Node(package="demo_robot", executable="driver", name="driver", parameters=[{"x": x, "y": y, "rate": rate}]),
            Node(package="demo_robot", executable="planner", arguments=["--robot", name, *args]),
        ]))
    if len(groups) > 1 and kwargs["leader"]:
        groups.append(Node(package="demo_robot", executable="leader", parameters=[{"robots": sorted(poses)}]))
    return groups


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("robots", default_value='{"bob": [1.0, 2.0], "ann": [0.5, 0.0]}'),
        DeclareLaunchArgument("rate", default_value="12.5"),
        OpaqueFunction(function=robots, args=["--fast"], kwargs={"leader": True}),
    ])
