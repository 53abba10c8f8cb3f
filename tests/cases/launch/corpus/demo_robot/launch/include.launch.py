from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource, PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("rate", default_value="42"),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource([ThisLaunchFileDir(), "/types.launch.py"]),
            launch_arguments={"rate": LaunchConfiguration("rate"), "use_sim_time": "true"}.items(),
        ),
        IncludeLaunchDescription(
            AnyLaunchDescriptionSource(PathJoinSubstitution([FindPackageShare("demo_robot"), "launch", "frontend.launch.xml"])),
            launch_arguments=[("frame", "included")],
        ),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(PathJoinSubstitution([FindPackageShare("not_here"), "launch", "far.launch.py"])),
            launch_arguments={"rate": LaunchConfiguration("rate")}.items(),
        ),
    ])
