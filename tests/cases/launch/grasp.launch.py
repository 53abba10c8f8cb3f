import os
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
import fogros2

PKG = "fogros2_examples"

def generate_launch_description():
    model = DeclareLaunchArgument("model", default_value="GQCNN-4.0-PJ")
    planner = Node(
        package=PKG, executable="grasp_planning_node", name="planner",
        parameters=[{"model": LaunchConfiguration("model"), "gain": 38.0, "rate": 10}],
        remappings=[("/image", "/camera/image")], output="screen",
    )
    fogros2.SkyLaunchDescription(
        [planner],
        constraint={"max_latency": 0.01, "max_cost": 0.01, "min_cpu": 2, "max_cpu": 64, "alpha": 0.7, "steps": 100},
        workdir="",
    )
    return LaunchDescription([
        model,
        Node(package=PKG, executable="client", parameters=[os.environ["X"], "config/p.yaml"], namespace="arm"),
        IncludeLaunchDescription("other.launch.py"),
    ])
