from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, TextSubstitution
from launch_ros.actions import Node, PushRosNamespace


def side(name):
    return GroupAction([
        PushRosNamespace(name),
        Node(package="demo_robot", executable="camera", name="camera", parameters=[{"frame_id": f"{name}_optical"}]),
        Node(package="demo_robot", executable="rectify", namespace="image", remappings=[("image", "image_rect")]),
    ])


def generate_launch_description():
    namespace = LaunchConfiguration("namespace")
    return LaunchDescription([
        DeclareLaunchArgument("namespace", default_value="robot1"),
        DeclareLaunchArgument("use_namespace", default_value="true"),
        GroupAction([
            PushRosNamespace(condition=IfCondition(LaunchConfiguration("use_namespace")), namespace=namespace),
            side("left"),
            side("right"),
            Node(package="demo_robot", executable="fuse", name=[namespace, TextSubstitution(text="_fuse")]),
        ]),
        Node(package="demo_robot", executable="outside", namespace=["/", namespace, "/tools"]),
    ])
