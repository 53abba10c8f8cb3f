"""What stands for an installed ROS 2 on the nodes: the packages of `make ros-env`, and of `ros2` what launches a file.

`ros2` itself is not on PyPI, nor is rmw_zenoh: nodes say what its nodes say, with the package eclipse-zenoh.
"""

import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
WHEELS = ROOT / ".venv-ros"
DISTRO = "jazzy"
PLAYER = ("tests/ros/playing.py", "tests/support/launching.py")

SETUP = 'export ROS_DISTRO={distro} PATH="/opt/ros/{distro}/bin:$PATH"\n'
ROS2 = """\
#!/bin/sh
[ "$1" = launch ] || exit 2
PYTHONPATH="/opt/ros/{distro}${{PYTHONPATH:+:$PYTHONPATH}}" exec python3 -m tests.ros.playing "$2"
"""


def prepare(folder: Path, python: Path) -> bool:
    """Make `folder`/ros as /opt/ros is to be; not without the wheels."""
    found = next(WHEELS.glob(f"lib/{python.name}/site-packages"), None)
    if found is None:
        return False
    home = folder / "ros" / DISTRO
    subprocess.run([python, "-m", "venv", "--without-pip", home], check=True)
    packages = next(home.glob("lib/python3.*/site-packages"))
    packages.rmdir()
    if subprocess.run(["cp", "-al", found, packages], capture_output=True).returncode:
        shutil.rmtree(packages, ignore_errors=True)
        subprocess.run(["cp", "-a", found, packages], check=True)
    # Their hooks would change every start of this Python, the agent's as well.
    for hook in packages.glob("*.pth"):
        hook.unlink()
    for name in PLAYER:
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, home / name)
    (home / "setup.bash").write_text(SETUP.format(distro=DISTRO))
    script = home / "bin" / "ros2"
    script.write_text(ROS2.format(distro=DISTRO))
    script.chmod(0o755)
    return True
