from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition, LaunchConfigurationEquals, LaunchConfigurationNotEquals, UnlessCondition
from launch.substitutions import AndSubstitution, LaunchConfiguration, NotSubstitution, OrSubstitution, PythonExpression
from launch_ros.actions import Node


def generate_launch_description():
    slam, backend, robots = (LaunchConfiguration(name) for name in ("slam", "backend", "robots"))
    several = PythonExpression([robots, " > 1"])
    return LaunchDescription([
        DeclareLaunchArgument("slam", default_value="False", choices=["True", "False"]),
        DeclareLaunchArgument("backend", default_value="cuda"),
        DeclareLaunchArgument("robots", default_value="2"),
        Node(package="demo_robot", executable="mapper", condition=IfCondition(slam)),
        Node(package="demo_robot", executable="localizer", condition=UnlessCondition(slam)),
        Node(package="demo_robot", executable="detector", name="detector", parameters=[{"backend": backend}],
             condition=IfCondition(PythonExpression(["'", backend, "' in ('cuda', 'tensorrt')"]))),
        Node(package="demo_robot", executable="fleet", condition=IfCondition(AndSubstitution(NotSubstitution(slam), several))),
        Node(package="demo_robot", executable="never", condition=IfCondition(AndSubstitution(slam, several))),
        Node(package="demo_robot", executable="either", condition=IfCondition(OrSubstitution(slam, several))),
        GroupAction([Node(package="demo_robot", executable="equal")], condition=LaunchConfigurationEquals("robots", "2")),
        GroupAction([Node(package="demo_robot", executable="other")], condition=LaunchConfigurationNotEquals("backend", "cuda")),
    ])
