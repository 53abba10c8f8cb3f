"""The set-up script of a machine builds the case studies' workspace with the real colcon, and rosdep resolves its packages.

Only what would change this computer or leave it is a stand-in: apt-get writes down what it is asked for, dpkg-query knows
that alone, and the index of ROS 2's packages is a file with those that the workspace names.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from fogspec.base.templates import render
from fogspec.compile.tasks import ros_environment
from fogspec.language.loader import load
from tests.ros.namespaces import PYTHON, ROOT
from tests.support.jobs import GENERATED

APT_GET = """\
case " $* " in *" install "*) ;; *) exit 0;; esac
while [ "$1" != install ]; do shift; done
shift
for name in "$@"; do case $name in -*) ;; *) echo "$name" >> "$HOME/installed" ;; esac; done
"""
DPKG_QUERY = """\
found=1
for name in "$@"; do
  case $name in -*) continue ;; esac
  grep -qxF -- "$name" "$HOME/installed" 2>/dev/null || continue
  found=0
  case "$*" in *db:Status*) printf installed ;; *) echo "$name install ok installed" ;; esac
done
exit "$found"
"""
STAND_INS = {
    "apt-get": APT_GET, "dpkg-query": DPKG_QUERY,
    "sudo": 'while [ "${1#-}" != "$1" ]; do shift; done; exec "$@"',
}  # fmt: skip
INDEX = """\
%YAML 1.1
---
distributions:
  jazzy: {distribution: [jazzy.yaml], distribution_status: active, distribution_type: ros2, python_version: 3}
type: index
version: 4
"""
DISTRIBUTION = """\
%YAML 1.1
---
release_platforms: {ubuntu: [noble]}
repositories:
  all:
    release:
      packages: [geometry_msgs, launch_ros, nav_msgs, rclpy, sensor_msgs, std_msgs]
      tags: {release: 'release/{package}/{version}'}
      url: https://example.invalid/all.git
      version: 1.0.0-1
type: distribution
version: 2
"""
KEYS = """\
python3-numpy: {ubuntu: [python3-numpy]}
python3-opencv: {ubuntu: [python3-opencv]}
python3-pip: {ubuntu: [python3-pip]}
python3-pytest: {ubuntu: [python3-pytest]}
"""


def index(folder: Path) -> dict[str, str]:
    """rosdep's lists as local files; the environment that names them."""
    folder.mkdir()
    for name, text in (("index.yaml", INDEX), ("jazzy.yaml", DISTRIBUTION), ("keys.yaml", KEYS)):
        (folder / name).write_text(text)
    (folder / "sources").mkdir()
    (folder / "sources" / "10-local.list").write_text(f"yaml {(folder / 'keys.yaml').as_uri()}\n")
    return {
        "ROSDEP_SOURCE_PATH": str(folder / "sources"),
        "ROSDISTRO_INDEX_URL": (folder / "index.yaml").as_uri(),
        "ROS_OS_OVERRIDE": "ubuntu:24.04:noble",
    }


@pytest.mark.slow
def test_colcon_builds_and_rosdep_resolves_the_workspace(tmp_path: Path) -> None:
    home, tools, ros, folder = (tmp_path / name for name in ("home", "bin", "ros", "specs"))
    for one in (home, tools, ros / "jazzy"):
        one.mkdir(parents=True)
    ignored = shutil.ignore_patterns("build", "install", "log", "__pycache__")
    shutil.copytree(ROOT / "specs", folder, ignore=ignored)
    for name, body in STAND_INS.items():
        (tools / name).write_text(f"#!/bin/sh\n{body}\n")
        (tools / name).chmod(0o755)
    (ros / "jazzy" / "setup.bash").write_text("export ROS_DISTRO=jazzy")
    [one] = load([folder / "vslam.yaml"])
    script = render("setup.sh.j2", **GENERATED, **ros_environment(one.application.spec))
    script = script.replace("/opt/ros", str(ros)).replace("export PATH=", f"export PATH={tools}:{PYTHON.parent}:")
    given = {"PATH": "/usr/bin:/bin", "HOME": str(home), **index(tmp_path / "index")}
    ended = subprocess.run(["bash", "-c", script], cwd=folder, env=given, capture_output=True, text=True, timeout=1200)
    assert ended.returncode == 0, (ended.stdout + ended.stderr)[-3000:]
    assert "3 packages finished" in ended.stdout
    for package, executable in (
        ("grasp_planning", "planner"), ("motion_planning", "planner"), ("visual_slam", "slam"), ("visual_slam", "client"),
    ):  # fmt: skip
        assert os.access(folder / "ros2_ws" / "install" / "lib" / package / executable, os.X_OK)
        assert (folder / "ros2_ws" / "install" / "share" / package / "launch" / f"{package}.launch.py").is_file()
    asked = (home / "installed").read_text().splitlines()
    assert {"ros-jazzy-rclpy", "ros-jazzy-launch-ros", "python3-numpy", "python3-opencv"} <= set(asked)
