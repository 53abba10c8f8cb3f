"""Makes the wheels of `make ros-env` look like an installed ROS 2: `python -m tests.tools.ros_prefix FOLDER`.

No wheel has `ros2`: of its verbs, `run` starts an executable that colcon installed, `launch` what a launch file of ours names.
"""

import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DISTRO = "jazzy"
PLAYER = ("tests/ros/playing.py", "tests/support/launching.py")

SETUP = 'export ROS_DISTRO={distro} PATH="{home}/bin:$PATH"\n'
ROS2 = """\
#!/bin/sh
case "$1" in
  run)
    prefix=
    if [ "$2" = --prefix ]; then prefix=$3; shift 2; fi
    [ "$#" -ge 3 ] || exit 2
    package=$2 executable=$3
    shift 3
    IFS=:
    for folder in $AMENT_PREFIX_PATH; do
      program=$folder/lib/$package/$executable
      if [ -x "$program" ]; then unset IFS; exec $prefix "$program" "$@"; fi
    done
    echo "no package $package with an executable $executable is in $AMENT_PREFIX_PATH" >&2
    exit 1
    ;;
  launch)
    PYTHONPATH="{home}${{PYTHONPATH:+:$PYTHONPATH}}" exec python3 -m tests.ros.playing "$2"
    ;;
esac
exit 2
"""


def write(folder: Path, home: str) -> None:
    """Write setup.bash and bin/ros2 into `folder`, which programs will see as `home`."""
    for name in PLAYER:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    (folder / "setup.bash").write_text(SETUP.format(distro=DISTRO, home=home))
    script = folder / "bin" / "ros2"
    script.write_text(ROS2.format(home=home))
    script.chmod(0o755)


if __name__ == "__main__":
    write(Path(sys.argv[1]), str(Path(sys.argv[1]).absolute()))
