from launch import LaunchDescription
from launch.actions import AppendEnvironmentVariable, DeclareLaunchArgument, ExecuteProcess, RegisterEventHandler, TimerAction
from launch.event_handlers import OnProcessExit
from launch.substitutions import EnvironmentVariable, FindExecutable, LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterFile


def generate_launch_description():
    first = Node(package="demo_robot", executable="first", prefix="nice -n 3", respawn=True, respawn_delay=1.5)
    return LaunchDescription([
        DeclareLaunchArgument("frame", default_value="map"),
        AppendEnvironmentVariable("DEMO_PATH", "/a"),
        AppendEnvironmentVariable("DEMO_PATH", "/b"),
        first,
        ExecuteProcess(cmd=[FindExecutable(name="ros2"), "topic", "echo", ["/", LaunchConfiguration("frame")]], additional_env={"A": "1"}),
        ExecuteProcess(cmd=["echo", "$HOME", "|", "cat"], shell=True),
        TimerAction(period=3.0, actions=[Node(package="demo_robot", executable="late")]),
        RegisterEventHandler(OnProcessExit(target_action=first, on_exit=[Node(package="demo_robot", executable="next")])),
        LifecycleNode(
            package="demo_robot", executable="planner", name="planner", namespace="",
            parameters=[ParameterFile([EnvironmentVariable("NOT_SET_ANYWHERE", default_value=""), "config/other.yaml"]), {"rate": 1}],
        ),
        Node(executable="tool", name="tool", arguments=["--x"]),
    ])
