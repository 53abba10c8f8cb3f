"""Launch a launch file as `ros2 launch` does, for `tests.ros.launch_facts`; runs in the Python that has `launch`."""

import sys

from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource

if __name__ == "__main__":
    service = LaunchService(noninteractive=True)
    source = AnyLaunchDescriptionSource(sys.argv[1])
    service.include_launch_description(LaunchDescription([IncludeLaunchDescription(source)]))
    sys.exit(service.run())
