"""What stands for an installed ROS 2 on the nodes: the packages of `make ros-env`.

rmw_zenoh is not on PyPI: nodes say what its nodes say, with the package eclipse-zenoh.
"""

import shutil
import subprocess
from pathlib import Path

from tests.tools import ros_prefix

ROOT = Path(__file__).resolve().parents[3]
WHEELS = ROOT / ".venv-ros"


def prepare(folder: Path, python: Path) -> bool:
    """Make `folder`/ros as /opt/ros is to be; not without the wheels."""
    found = next(WHEELS.glob(f"lib/{python.name}/site-packages"), None)
    if found is None:
        return False
    home = folder / "ros" / ros_prefix.DISTRO
    subprocess.run([python, "-m", "venv", "--without-pip", home], check=True)
    packages = next(home.glob("lib/python3.*/site-packages"))
    packages.rmdir()
    if subprocess.run(["cp", "-al", found, packages], capture_output=True).returncode:
        shutil.rmtree(packages, ignore_errors=True)
        subprocess.run(["cp", "-a", found, packages], check=True)
    # Their hooks would change every start of this Python, the agent's as well.
    for hook in packages.glob("*.pth"):
        hook.unlink()
    ros_prefix.write(home, f"/opt/ros/{ros_prefix.DISTRO}")
    return True
