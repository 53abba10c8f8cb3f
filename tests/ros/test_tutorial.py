"""The tutorial with real ROS 2 nodes does what it shows: from a workspace to a robot that is connected."""

import os
from pathlib import Path

import pytest

from tests.docs.running import mistakes, run
from tests.docs.test_commands import WITH_ROS
from tests.ros.benching import FOGSPEC
from tests.ros.namespaces import LEAKED, PYTHON, Net
from tests.tools import ros_prefix

pytestmark = pytest.mark.slow
LONGEST_S = 1500.0  # a bound against hangs


@pytest.mark.parametrize("page", WITH_ROS, ids=lambda page: str(page.name))
def test_the_tutorial_ends_with_a_robot_that_is_connected(page: Path, net: Net, tmp_path: Path) -> None:
    (tmp_path / "ros").mkdir()
    (tmp_path / "ros" / "bin").mkdir()
    ros_prefix.write(tmp_path / "ros", str(tmp_path / "ros"))
    folder = tmp_path / "page"
    folder.mkdir()
    seen = net.environment()
    ros = {name: value for name, value in seen.items() if name.startswith("ROS_")}
    first = [str(tmp_path / "ros" / "bin"), str(PYTHON.parent), str(FOGSPEC.parent), os.defpath]
    variables = {**ros, "ROS_DISTRO": ros_prefix.DISTRO, "PATH": os.pathsep.join(first)}
    assert not variables.keys() & set(LEAKED)
    assert not mistakes(page, run(page, folder, net.command, variables, LONGEST_S))
