import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.descriptions import ParameterFile


def generate_launch_description():
    folder = os.path.join(get_package_share_directory("demo_bringup"), "config")
    return LaunchDescription([
        DeclareLaunchArgument("params_file", default_value=os.path.join(folder, "navigation.yaml")),
        DeclareLaunchArgument("threshold", default_value="0.4"),
        Node(package="nav_demo", executable="planner_server", name="planner_server",
             parameters=[LaunchConfiguration("params_file"), {"use_sim_time": True, "costmap": {"width": 3, "rolling": False}}]),
        Node(package="demo_robot", executable="detector",
             parameters=[ParameterFile(os.path.join(folder, "detector.yaml"), allow_substs=True)]),
        Node(package="nav_demo", executable="controller_server", name="controller_server",
             parameters=[ParameterFile(LaunchConfiguration("params_file")), {"frames": ["base", "odom"], "gains": [1.0, 2.0]}]),
    ])
