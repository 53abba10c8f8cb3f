from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, SetRemap

TF = [("/tf", "tf"), ("/tf_static", "tf_static")]


def generate_launch_description():
    scan = LaunchConfiguration("scan")
    topics = {"cmd_vel": "cmd_vel_nav", "odom": "/wheel/odom"}
    return LaunchDescription([
        DeclareLaunchArgument("scan", default_value="scan_filtered"),
        Node(package="demo_robot", executable="follower", remappings=TF + list(topics.items()) + [("scan", scan)]),
        Node(package="demo_robot", executable="merger", remappings=[(f"in{i}", ["scan_", str(i)]) for i in range(3)]),
        GroupAction([
            SetRemap(src="scan", dst=scan),
            SetRemap(src="/map", dst="map"),
            Node(package="demo_robot", executable="slam", remappings=[*TF, ("/map", "/ignored")]),
        ]),
        Node(package="demo_robot", executable="plain", remappings=TF),
    ])
