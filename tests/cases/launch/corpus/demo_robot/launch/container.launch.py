import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, PushRosNamespace, SetParameter
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    config = os.path.join(get_package_share_directory("demo_robot"), "config", "planner.yaml")
    container = ComposableNodeContainer(
        name="vision",
        namespace="camera",
        package="rclcpp_components",
        executable="component_container_mt",
        composable_node_descriptions=[
            ComposableNode(
                package="image_proc", plugin="image_proc::RectifyNode", name="rectify", namespace="left",
                parameters=[{"queue_size": 5}], remappings=[("image", "image_raw")],
                extra_arguments=[{"use_intra_process_comms": LaunchConfiguration("intra")}],
            ),
            ComposableNode(
                package="image_proc", plugin="image_proc::CropNode", condition=IfCondition(LaunchConfiguration("crop")),
            ),
        ],
        arguments=["--ros-args", "--log-level", "warn"],
    )
    return LaunchDescription([
        DeclareLaunchArgument("intra", default_value="true"),
        DeclareLaunchArgument("crop", default_value="false"),
        container,
        GroupAction([
            PushRosNamespace("robot"),
            SetParameter("use_sim_time", True),
            LoadComposableNodes(
                target_container="camera/vision",
                composable_node_descriptions=[
                    ComposableNode(package="demo_robot", plugin="demo_robot::Planner", name="planner", parameters=[config, {"rate": 7.0}]),
                ],
            ),
        ]),
    ])
