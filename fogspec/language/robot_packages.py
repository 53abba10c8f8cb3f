"""Which nodes belong on the robot, by a list of packages and programs with a reason each, and by topics (ADR 0142)."""

import os.path
import re
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from functools import cache
from typing import Any

MOVING_TOPIC = re.compile(r"(?:.*/)?(?:cmd_vel\w*|joint_trajectory)")
COMPONENTS = "composable_node_descriptions"


def reason_of(node: Mapping[str, Any], moving: Iterable[str] = ()) -> str | None:
    """Return why a node belongs on the robot; None if nothing says so. `moving` are the names of nodes that move it."""
    parts = [node, *node.get(COMPONENTS, [])]
    program = _listed("programs", os.path.basename(node.get("cmd", [""])[0]))
    return program or next(filter(None, (_of_package(one) or why_moving(one, moving) for one in parts)), None)


def why_moving(node: Mapping[str, Any], moving: Iterable[str] = ()) -> str | None:
    """Return how a node or component moves or stops the robot, as far as package, remappings and parameters show."""
    values, argv = node.get("parameters", {}), node.get("cmd", [])
    words = [*node.get("remappings", {}).items(), *(one.split(":=") for one in argv), map(str, values.values())]
    topic = next((word for some in words for word in some if MOVING_TOPIC.fullmatch(word)), None)
    managed = sorted(set(moving).intersection(re.findall(r"\w+", str(values.get("node_names", "")))))
    uses = f"uses {topic}, by which the robot moves" if topic else None
    return _of_package(node, moves=True) or uses or (f"starts and stops {', '.join(managed)}" if managed else None)


def moving_names(nodes: Iterable[Mapping[str, Any]]) -> set[str]:
    """Return the names of the nodes and components that move or stop the robot."""
    parts = [part for node in nodes for part in (node, *node.get(COMPONENTS, []))]
    return {str(part.get("name") or part.get("executable")) for part in parts if why_moving(part)}


def _of_package(node: Mapping[str, Any], moves: bool = False) -> str | None:
    argv = node.get("cmd", [])
    started = argv[:1] == ["ros2"] and len(argv) > 2 and argv[1] in ("launch", "run")
    return _listed("packages", argv[2] if started else node.get("package", ""), moves)


def _listed(kind: str, name: str, moves: bool = False) -> str | None:
    groups = (one for one in _groups() if one.get("moves") or not moves)
    return next((one["reason"] for one in groups if any(fnmatchcase(name, like) for like in one.get(kind, []))), None)


@cache
def _groups() -> Any:
    import tomllib
    from importlib.resources import files

    return tomllib.loads(files(__package__).joinpath("robot_packages.toml").read_text("utf-8"))["group"]
