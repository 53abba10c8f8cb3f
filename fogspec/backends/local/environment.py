"""The variables of this shell that the processes of a job get: a list of what ROS 2 programs need, and no others.

A shell has keys under any name (`OPENAI_KEY`, `GITHUB_PAT`, `KUBECONFIG`), so that no list of what to keep back is whole. HOME
is the user's own: ROS 2 writes its logs there, packages and models that the user installed are there. This is not a sandbox:
the processes are the user's and can read the user's files.
"""

import re
from collections.abc import Collection, Mapping

from fogspec.base.redaction import SECRET_KEY

PASSED = (
    "PATH", "HOME", "USER", "LOGNAME", "SHELL", "LANG", "LANGUAGE", "TZ", "TMPDIR", "TERM",
    "PYTHONPATH", "PYTHONUNBUFFERED", "VIRTUAL_ENV", "CONDA_PREFIX", "LD_LIBRARY_PATH", "CMAKE_PREFIX_PATH",
    "DISPLAY", "WAYLAND_DISPLAY", "XAUTHORITY", "XDG_RUNTIME_DIR",
)  # fmt: skip
PASSED_PREFIXES = (
    "LC_", "ROS_", "RMW_", "RCUTILS_", "RCL_", "AMENT_", "COLCON_", "CYCLONEDDS_", "FASTRTPS_", "FASTDDS_", "ZENOH_",
    "GZ_", "GAZEBO_", "IGN_", "OMP_", "CUDA_", "NVIDIA_",
)  # fmt: skip
# A number of threads that is set in the shell would hide the job's CPUs.
THREADS = re.compile(r"_NUM_THREADS$|^OMP_THREAD_LIMIT$")


def passed(shell: Mapping[str, str], named: Collection[str] = ()) -> dict[str, str]:
    """Return the variables of `shell` that a job gets; `named` are those that its spec names."""
    return {name: value for name, value in shell.items() if name in named or _is_passed(name)}


def _is_passed(name: str) -> bool:
    listed = name in PASSED or name.startswith(PASSED_PREFIXES)
    return listed and not SECRET_KEY.search(name) and not THREADS.search(name)
