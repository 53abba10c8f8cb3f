"""What takes part in the graph shares this: finding rclpy, message types, quality of service. Standard library only."""

import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
from typing import Any

from .pairing import HEADER

LOOKED = "FOGSPEC_LOOKED_FOR_RCLPY"


def need_rclpy(module: str) -> None:
    """Go on in a Python that has rclpy: this one, or another python3 on PATH; ends the process when there is none."""
    if importlib.util.find_spec("rclpy") is not None:
        return
    if LOOKED not in os.environ:
        for folder in [*os.environ.get("PATH", os.defpath).split(os.pathsep), "/usr/bin"]:
            python = shutil.which("python3", path=folder)
            if python and subprocess.run([python, "-c", "import rclpy"], capture_output=True).returncode == 0:
                os.execve(python, [python, "-m", f"{__package__}.{module}", *sys.argv[1:]], {**os.environ, LOOKED: "1"})  # noqa: S606
    sys.exit("no python3 on PATH has rclpy: ROS 2 is not there, or its environment was not sourced (spec.ros)")


def type_of(kind: str) -> Any:
    """The class of `package/msg/Name` or `package/srv/Name`; ends the process when it is not there."""
    package, _, name = kind.rpartition("/")
    try:
        return getattr(importlib.import_module(package.replace("/", ".")), name)
    except (ImportError, AttributeError):
        sys.exit(f"the type {kind} is not installed here")


def message_of(kind: str) -> tuple[Any, bool]:
    """The message class of `package/msg/Name`, and whether it begins with a header."""
    message_type = type_of(kind)
    first = next(iter(message_type.get_fields_and_field_types().values()), "")
    return message_type, first == HEADER


def hearing() -> Any:
    """Best effort hears every publisher, reliable ones too."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
