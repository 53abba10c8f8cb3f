from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


class Kind(Enum):
    LIDAR = "lidar"
    CAMERA = "camera"


class Pose(NamedTuple):
    x: float
    y: float = 0.0


@dataclass
class Sensor:
    name: str
    kind: Kind
    pose: Pose
    options: dict = field(default_factory=dict)

    @property
    def frame(self):
        return f"{self.name}_link"

    def node(self):
        return Node(package="demo_robot", executable=self.kind.value, name=self.name,
                    parameters=[{"frame": self.frame, "x": self.pose.x, "y": self.pose.y, **self.options}])


class Arguments:
    def __init__(self, **defaults):
        self.declared = [DeclareLaunchArgument(name, default_value=str(value)) for name, value in defaults.items()]
        for name in defaults:
            setattr(self, name, LaunchConfiguration(name))


def generate_launch_description():
    arguments = Arguments(rate=20, topic="points")
    sensors = [
        Sensor("top", Kind.LIDAR, Pose(0.1, 0.2), {"rate": arguments.rate}),
        Sensor("eye", Kind.CAMERA, Pose(x=0.3), {"topic": arguments.topic}),
    ]
    return LaunchDescription(arguments.declared + [one.node() for one in sensors])
