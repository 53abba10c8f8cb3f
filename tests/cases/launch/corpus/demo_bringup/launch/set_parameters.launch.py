from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, SetParameter, SetParametersFromFile
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    config = PathJoinSubstitution([FindPackageShare("demo_bringup"), "config", "navigation.yaml"])
    return LaunchDescription([
        DeclareLaunchArgument("use_sim_time", default_value="true"),
        SetParameter(name="use_sim_time", value=LaunchConfiguration("use_sim_time")),
        GroupAction([
            SetParameter("base_frame", "base_link"),
            SetParametersFromFile(config),
            Node(package="nav_demo", executable="planner_server", name="planner_server", parameters=[{"rate": 5}]),
        ]),
        Node(package="nav_demo", executable="bt_navigator", parameters=[{"use_sim_time": False}]),
        Node(package="nav_demo", executable="waypoints"),
    ])
