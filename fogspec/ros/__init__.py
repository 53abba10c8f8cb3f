"""For a robot's own ROS 2 launch files: `from fogspec.ros import SkyLaunchDescription`.

Runs in the robot's ROS 2 environment: needs the standard `launch` package and PyYAML, which ROS 2 brings, and nothing
else of fogspec. `launch` is imported when the class is first used.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    if name != "SkyLaunchDescription":
        raise AttributeError(f"fogspec.ros has no {name}")
    from fogspec.ros.description import SkyLaunchDescription

    return SkyLaunchDescription
