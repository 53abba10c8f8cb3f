from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    gui = LaunchConfiguration("gui")
    world = PathJoinSubstitution([FindPackageShare("demo_bringup"), "worlds", "hall.sdf"])
    return LaunchDescription([
        DeclareLaunchArgument("gui", default_value="false"),
        DeclareLaunchArgument("nice", default_value="5"),
        ExecuteProcess(cmd=["simulate", "-r", "-s", world], additional_env={"DEMO_GUI": gui}, output="screen"),
        ExecuteProcess(cmd=["viewer", world], condition=IfCondition(gui)),
        ExecuteProcess(cmd=["record", "--topics", ["/robot", "/scan"], PythonExpression(["'--all' if '", gui, "' == 'true' else '--some'"])]),
        GroupAction([
            Node(package="demo_robot", executable="planner", prefix=["nice -n ", LaunchConfiguration("nice")], respawn=True,
                 respawn_delay=1.5, ros_arguments=["--log-level", "debug"], exec_name="planner"),
        ]),
        Node(package="demo_robot", executable="bridge", arguments=["/clock@demo/Clock[sim.Clock", "--ros-args", "-r", "/clock:=/sim/clock"]),
    ])
