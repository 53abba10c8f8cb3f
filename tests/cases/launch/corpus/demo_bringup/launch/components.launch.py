from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    composed, name = LaunchConfiguration("use_composition"), LaunchConfiguration("container_name")
    description = [
        ComposableNode(package="demo_robot", plugin="demo_robot::Decoder", name="decoder", namespace="cam",
                       remappings=[("image/compressed", "/camera/image/compressed")]),
        ComposableNode(package="demo_robot", plugin="demo_robot::Detector", name="detector",
                       parameters=[{"threshold": 0.5, "classes": ["person", "cup"]}],
                       extra_arguments=[{"use_intra_process_comms": True}]),
    ]
    return LaunchDescription([
        DeclareLaunchArgument("use_composition", default_value="True"),
        DeclareLaunchArgument("container_name", default_value="perception"),
        ComposableNodeContainer(name=name, namespace="", package="rclcpp_components", executable="component_container_isolated",
                                composable_node_descriptions=[], arguments=["--use_multi_threaded_executor"],
                                condition=IfCondition(composed)),
        LoadComposableNodes(target_container=name, composable_node_descriptions=description, condition=IfCondition(composed)),
        GroupAction([Node(package="demo_robot", executable="detector")],
                    condition=IfCondition(PythonExpression(["not ", composed]))),
    ])
