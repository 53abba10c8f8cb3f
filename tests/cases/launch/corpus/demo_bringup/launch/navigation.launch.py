import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, PushRosNamespace, SetParameter
from launch_ros.descriptions import ParameterFile
from nav2_common.launch import RewrittenYaml


def generate_launch_description():
    share = get_package_share_directory("demo_bringup")
    namespace, params_file = LaunchConfiguration("namespace"), LaunchConfiguration("params_file")
    configured = ParameterFile(
        RewrittenYaml(
            source_file=params_file,
            root_key=namespace,
            param_rewrites={"autostart": "true", "odom_topic": "/wheel/odom", "yaml_filename": os.path.join(share, "maps", "hall.yaml")},
            convert_types=True,
        ),
        allow_substs=True,
    )
    servers = ["planner_server", "controller_server", "map_server"]
    return LaunchDescription([
        SetEnvironmentVariable("RCUTILS_LOGGING_BUFFERED_STREAM", "1"),
        DeclareLaunchArgument("namespace", default_value="amr"),
        DeclareLaunchArgument("params_file", default_value=os.path.join(share, "config", "navigation.yaml")),
        DeclareLaunchArgument("log_level", default_value="info"),
        GroupAction([
            PushRosNamespace(namespace),
            SetParameter("use_sim_time", False),
            *(Node(package="nav_demo", executable=name, name=name, parameters=[configured], remappings=[("/tf", "tf")],
                   arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")], respawn=True, respawn_delay=2.0)
              for name in servers),
            Node(package="nav_demo", executable="lifecycle_manager", name="manager",
                 parameters=[{"autostart": True}, {"node_names": servers}]),
        ]),
    ])
