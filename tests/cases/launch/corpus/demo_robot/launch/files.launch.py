from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    config = PathJoinSubstitution([FindPackageShare("demo_robot"), "config"])
    return LaunchDescription([
        DeclareLaunchArgument("frame", default_value="odom"),
        Node(
            package="demo_robot", executable="planner", name="planner",
            parameters=[ParameterFile([config, "/substituted.yaml"], allow_substs=True), [config, "/planner.yaml"], {"frame_id": LaunchConfiguration("frame")}],
        ),
        Node(
            package="demo_robot", executable="planner", name="other",
            parameters=[{"rate": 9.0, "kept": 1}, [config, "/planner.yaml"]],
        ),
    ])
