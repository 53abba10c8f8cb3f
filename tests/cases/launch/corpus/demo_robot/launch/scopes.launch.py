import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, SetEnvironmentVariable, SetLaunchConfiguration
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import AndSubstitution, EqualsSubstitution, LaunchConfiguration, NotSubstitution
from launch_ros.actions import Node, PushROSNamespace, PushRosNamespace, SetParameter, SetParametersFromFile, SetRemap


def generate_launch_description():
    share = get_package_share_directory("demo_robot")
    real = LaunchConfiguration("real")
    return LaunchDescription([
        DeclareLaunchArgument("real", default_value="True"),
        DeclareLaunchArgument("mode", default_value="slam"),
        SetEnvironmentVariable("RCUTILS_COLORIZED_OUTPUT", "1"),
        GroupAction([
            PushROSNamespace("fleet"),
            SetRemap("/scan", "/laser/scan"),
            SetParameter("use_sim_time", NotSubstitution(real)),
            SetEnvironmentVariable("ONLY_HERE", LaunchConfiguration("mode")),
            SetLaunchConfiguration("mode", "inner"),
            GroupAction([
                PushRosNamespace("one"),
                Node(package="demo_robot", executable="driver", name="driver", remappings=[("/scan", "/ignored"), ("a", "b")]),
            ]),
            Node(package="demo_robot", executable="mode", namespace="/absolute", parameters=[{"mode": LaunchConfiguration("mode")}]),
        ]),
        GroupAction([Node(package="demo_robot", executable="never")], condition=UnlessCondition(real)),
        GroupAction(
            scoped=False,
            actions=[SetLaunchConfiguration("mode", "leaked"), SetParametersFromFile(os.path.join(share, "config", "planner.yaml"))],
        ),
        Node(
            package="demo_robot", executable="after", name="planner", parameters=[{"mode": LaunchConfiguration("mode")}],
            condition=IfCondition(AndSubstitution(real, EqualsSubstitution(LaunchConfiguration("mode"), "leaked"))),
        ),
    ])
