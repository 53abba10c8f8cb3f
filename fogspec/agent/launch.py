"""Have ROS 2's own launch play a launch file that is given as text: a container of components is measured like a node.

Needs the packages `launch` and `launch_ros` of the sourced ROS 2. Ends with the exit code of launch, which ends what it
started on request.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Play the text; return launch's exit code."""
    parser = argparse.ArgumentParser(prog="agent.pyz launch", description=__doc__)
    parser.add_argument("text", help="a Python launch file")
    text = parser.parse_args(argv).text
    from launch import LaunchService
    from launch.actions import IncludeLaunchDescription
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    with tempfile.NamedTemporaryFile("w", suffix=".launch.py", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        service = LaunchService(argv=[])
        service.include_launch_description(IncludeLaunchDescription(PythonLaunchDescriptionSource(file.name)))
        return int(service.run())


if __name__ == "__main__":
    sys.exit(main())
