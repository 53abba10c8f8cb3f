"""What stands for an installed ROS 2 on the nodes: the packages of `make ros-env`.

rmw_zenoh is not on PyPI: nodes say what its nodes say, with the package eclipse-zenoh.
"""

import subprocess
from collections.abc import Sequence
from pathlib import Path

from tests.tools import ros_prefix

ROOT = Path(__file__).resolve().parents[3]
WHEELS = ROOT / ".venv-ros"
COLCON = "#!{python}\nfrom colcon_core.command import main\n\nraise SystemExit(main())\n"


def prepare(folder: Path, python: Path) -> bool:
    """Make `folder`/ros as /opt/ros is to be; not without the wheels."""
    found = next(WHEELS.glob(f"lib/{python.name}/site-packages"), None)
    if found is None:
        return False
    home, seen_as = folder / "ros" / ros_prefix.DISTRO, Path("/opt/ros", ros_prefix.DISTRO)
    subprocess.run([python, "-m", "venv", "--without-pip", home], check=True)
    packages = next(home.glob("lib/python3.*/site-packages"))
    _copy([f"{found}/."], packages)
    _copy([f"{WHEELS}/share"], home)
    _copy([str(one) for one in WHEELS.glob("lib/lib*.so*")], home / "lib")
    # Their hooks would change every start of this Python, the agent's as well: setup.bash says where the libraries are.
    for hook in packages.glob("*.pth"):
        hook.unlink()
    ros_prefix.write(home, str(seen_as))
    libraries = [home / "lib", *sorted(packages.glob("ros_*.libs"))]
    paths = ":".join(str(seen_as / one.relative_to(home)) for one in libraries)
    with open(home / "setup.bash", "a") as file:
        file.write(f'export LD_LIBRARY_PATH="{paths}:${{LD_LIBRARY_PATH-}}"\n')
    colcon = home / "bin" / "colcon"
    colcon.write_text(COLCON.format(python=seen_as / "bin" / "python3"))
    colcon.chmod(0o755)
    return True


def _copy(sources: Sequence[str], folder: Path) -> None:
    """Copy into a folder: hard links where that is possible."""
    words = ["cp", "--archive", "--force", *sources, str(folder)]
    if subprocess.run([*words, "--link"], capture_output=True).returncode:
        subprocess.run(words, check=True)
