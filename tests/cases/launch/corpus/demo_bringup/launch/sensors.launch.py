from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    share = Path(get_package_share_directory("demo_bringup"))
    with open(share / "config" / "sensors.yaml") as file:
        sensors = yaml.safe_load(file)
    nodes = [
        Node(package="demo_robot", executable="camera", name=name, namespace="sensors", parameters=[values])
        for name, values in sensors.items()
    ]
    config = share.joinpath("config", "navigation.yaml")
    frequency = yaml.safe_load(config.read_text())["controller_server"]["ros__parameters"]["controller_frequency"]
    nodes.append(Node(package="demo_robot", executable="watchdog", parameters=[{"period": 1 / frequency}, str(config)]))
    if (share / "config" / "missing.yaml").exists():
        nodes.append(Node(package="demo_robot", executable="never"))
    return LaunchDescription(nodes)
