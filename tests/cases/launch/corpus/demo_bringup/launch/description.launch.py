import os

import xacro
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import Command, FindExecutable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    path = PathJoinSubstitution([FindPackageShare("demo_bringup"), "urdf", "arm.urdf.xacro"])
    command = Command([FindExecutable(name="xacro"), " ", path, " prefix:=", LaunchConfiguration("prefix")])
    file = os.path.join(get_package_share_directory("demo_bringup"), "urdf", "arm.urdf.xacro")
    made = xacro.process_file(file, mappings={"fake": "true"}).toxml()
    return LaunchDescription([
        DeclareLaunchArgument("prefix", default_value="left_"),
        Node(package="robot_state_publisher", executable="robot_state_publisher",
             parameters=[{"robot_description": ParameterValue(command, value_type=str), "publish_frequency": 50.0}]),
        Node(package="controller_demo", executable="ros2_control_node", parameters=[{"robot_description": made, "rate": 100}]),
    ])
