"""Have ROS 2's own launch play a launch file that is given as text: a container of components is measured like a node.

Needs the packages `launch` and `launch_ros` of the sourced ROS 2. Ends with the exit code of the node that failed, which
launch itself does not pass on, or else with launch's. Launch ends on request what it started.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Play the text; return the exit code."""
    parser = argparse.ArgumentParser(prog="agent.pyz launch", description=__doc__)
    parser.add_argument("text", help="a Python launch file")
    text = parser.parse_args(argv).text
    from launch import LaunchDescription, LaunchService
    from launch.actions import IncludeLaunchDescription, RegisterEventHandler
    from launch.event_handlers import OnProcessExit
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    codes: list[int] = []
    seen = OnProcessExit(on_exit=lambda event, _context: codes.append(event.returncode))

    with tempfile.NamedTemporaryFile("w", suffix=".launch.py", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        service = LaunchService(argv=[])
        played = IncludeLaunchDescription(PythonLaunchDescriptionSource(file.name))
        service.include_launch_description(LaunchDescription([RegisterEventHandler(seen), played]))
        code = int(service.run())
    # A signal's negative number cannot be an exit code: the shell's way of writing it is.
    return next((one if one > 0 else 128 - one for one in codes if one), code)


if __name__ == "__main__":
    sys.exit(main())
