from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from moveit_configs_utils import MoveItConfigsBuilder


def generate_launch_description():
    config = (
        MoveItConfigsBuilder("arm", package_name="arm_moveit_config")
        .robot_description(file_path="config/arm.urdf.xacro")
        .trajectory_execution(file_path="config/controllers.yaml")
        .to_moveit_configs()
    )
    return LaunchDescription([
        DeclareLaunchArgument("rviz", default_value="false"),
        Node(package="moveit_ros_move_group", executable="move_group", parameters=[config.to_dict(), {"use_sim_time": True}],
             arguments=["--ros-args", "--log-level", "info"]),
        Node(package="demo_robot", executable="grasp", name="grasp",
             parameters=[config.robot_description, config.robot_description_semantic, {"attempts": 3}]),
        Node(package="rviz2", executable="rviz2", parameters=[config.planning_pipelines], condition=IfCondition(LaunchConfiguration("rviz"))),
    ])
