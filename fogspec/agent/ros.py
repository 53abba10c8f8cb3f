"""Shared by the programs that take part in the ROS graph: rclpy, message types, quality of service."""

import contextlib
import importlib
import os
import random
import shutil
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .graph_variables import PLACE
from .matching import HEADER

RESTARTED = "FOGSPEC_LOOKED_FOR_RCLPY"
DOMAINS = range(1, 102)  # those whose ports are below Linux's ephemeral ones
FIRST_PORT, PORTS_A_DOMAIN, FIRST_UNICAST = 7400, 250, 10  # RTPS 2.5, 9.6.2.3: what discovery listens on
PARTICIPANTS = 10
# On an interface without multicast, which loopback is, CycloneDDS finds a port for ten processes at most, if nothing is said.
CYCLONE = (
    "<CycloneDDS><Domain><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>119</MaxAutoParticipantIndex></Discovery></Domain></CycloneDDS>"
)
RELIABLE = 1  # of rmw_qos_reliability_policy_t


def need_rclpy(module: str, arguments: Sequence[str]) -> None:
    """Continue in a Python that has rclpy: this one, or another python3 on PATH; exit if there is none."""
    # Another version's rclpy may be on PYTHONPATH, which can be found and not imported.
    with contextlib.suppress(ImportError):
        importlib.import_module("rclpy")
        return
    if RESTARTED not in os.environ:
        path = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
        environment = {**os.environ, "PYTHONPATH": path, RESTARTED: "1"}
        for folder in [*os.environ.get("PATH", os.defpath).split(os.pathsep), "/usr/bin"]:
            python = shutil.which("python3", path=folder)
            if python and subprocess.run([python, "-c", "import rclpy"], capture_output=True).returncode == 0:
                os.execve(python, [python, "-m", f"{__package__}.{module}", *arguments], environment)  # noqa: S606
    sys.exit("no python3 on PATH has rclpy: ROS 2 is not there, or its environment was not sourced (spec.ros)")


def alone(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment with a ROS graph of this sample's own, whatever it says.

    Machines of one network, and other programs on this one, would be heard by the measured nodes, and answered: a robot whose
    domain the shell has would be driven.
    """
    humble = environment.get("ROS_DISTRO") == "humble"
    local = {"ROS_LOCALHOST_ONLY": "1"} if humble else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    rest = {name: value for name, value in environment.items() if name not in PLACE}
    return {"CYCLONEDDS_URI": CYCLONE, **rest, **local, "ROS_DOMAIN_ID": str(_unused_domain())}


def _unused_domain() -> int:
    """Return a DDS domain in which no process on this machine listens; they are tried in random order."""
    domains = random.sample(DOMAINS, len(DOMAINS))
    return next(filter(_is_unused, domains), domains[0])


def _is_unused(domain: int) -> bool:
    first = FIRST_PORT + PORTS_A_DOMAIN * domain
    try:
        for port in (first, *(first + FIRST_UNICAST + 2 * i for i in range(PARTICIPANTS))):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
                one.bind(("", port))
    except OSError:
        return False
    return True


def type_of(kind: str) -> Any:
    """Return the class of `package/msg/Name`, `package/srv/Name` or `package/srv/Name_Event`; exit if it is not installed."""
    package, _, name = kind.rpartition("/")
    try:
        module = importlib.import_module(package.replace("/", "."))
        if package.endswith("/srv") and name.endswith("_Event"):
            return getattr(module, name[: -len("_Event")]).Event
        return getattr(module, name)
    except (ImportError, AttributeError):
        sys.exit(f"the type {kind} is not installed here")


def message_of(kind: str) -> tuple[Any, bool]:
    """Return the message class of `package/msg/Name` and whether it begins with a header."""
    message_type = type_of(kind)
    first = next(iter(message_type.get_fields_and_field_types().values()), "")
    return message_type, first == HEADER


def listening_qos(reliable: bool = False) -> Any:
    """Return a quality of service to listen with: best effort, which receives from reliable publishers too, or reliable."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=reliability)


def offered(node: Any, topic: str) -> list[bool]:
    """Return of each publisher of a topic that is known whether it is reliable."""
    return [int(one.qos_profile.reliability) == RELIABLE for one in node.get_publishers_info_by_topic(topic)]


def offers_reliably(node: Any, topic: str) -> bool:
    """Return whether a topic is published, and all that publish it do so reliably."""
    found = offered(node, topic)
    return bool(found) and all(found)
