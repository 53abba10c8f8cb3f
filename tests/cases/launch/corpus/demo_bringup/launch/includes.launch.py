import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource, PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import PushRosNamespace
from launch_ros.substitutions import FindPackageShare
from launch_xml.launch_description_sources import XMLLaunchDescriptionSource


def generate_launch_description():
    here = os.path.join(get_package_share_directory("demo_bringup"), "launch")
    share = FindPackageShare("demo_bringup")
    return LaunchDescription([
        DeclareLaunchArgument("backend", default_value="tensorrt"),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(os.path.join(here, "conditions.launch.py")),
            launch_arguments={"slam": "True", "backend": LaunchConfiguration("backend"), "robots": "1"}.items(),
        ),
        GroupAction([
            PushRosNamespace("second"),
            IncludeLaunchDescription(PythonLaunchDescriptionSource([share, "/launch", "/groups.launch.py"]),
                                     launch_arguments=[("namespace", "inner")]),
        ]),
        IncludeLaunchDescription(XMLLaunchDescriptionSource([ThisLaunchFileDir(), "/arguments.launch.xml"]),
                                 launch_arguments={"rate": "25"}.items()),
        IncludeLaunchDescription(AnyLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "nodes.launch.yaml"]))),
    ])
