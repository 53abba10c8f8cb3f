from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetLaunchConfiguration
from launch.conditions import IfCondition
from launch.substitutions import (
    EqualsSubstitution,
    IfElseSubstitution,
    LaunchConfiguration,
    PathJoinSubstitution,
    PythonExpression,
    TextSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    robot, count = LaunchConfiguration("robot"), LaunchConfiguration("count")
    return LaunchDescription([
        DeclareLaunchArgument("robot", default_value="rover"),
        DeclareLaunchArgument("count", default_value="3"),
        DeclareLaunchArgument("map", default_value=[FindPackageShare("demo_bringup"), "/maps/", robot, ".yaml"]),
        SetLaunchConfiguration("name", [robot, "_", count]),
        Node(package="demo_robot", executable="planner", name=LaunchConfiguration("name"), parameters=[{
            "map": LaunchConfiguration("map"),
            "double": PythonExpression(["2 * ", count]),
            "ratio": ParameterValue(PythonExpression([count, " / 2"]), value_type=float),
            "flag": PythonExpression(["'", robot, "'.startswith('r')"]),
            "text": ParameterValue(count, value_type=str),
            "frames": [[robot, "/base"], [TextSubstitution(text="map")]],
            "nested": {"path": PathJoinSubstitution([FindPackageShare("demo_bringup"), robot])},
            "kind": IfElseSubstitution(EqualsSubstitution(robot, "rover"), if_value="wheels", else_value="legs"),
        }]),
        Node(package="demo_robot", executable="many", condition=IfCondition(PythonExpression([count, " >= 3 and '", robot, "' != ''"]))),
    ])
