"""A spec that is valid, of what a launch file starts: which nodes stay on the robot, and what a spec has no words for."""

import os.path
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fogspec.agent.graph_variables import is_of_graph
from fogspec.importers.launch.constraints import PROBE, UNREADABLE
from fogspec.importers.launch.found import LaunchImport, Place, ros_words, tidy
from fogspec.importers.launch.packages import Packages
from fogspec.language.robot_packages import COMPONENTS, moving_names, reason_of, why_moving
from fogspec.language.rules.nodes import GRAPH_NAME


def propose(found: LaunchImport, packages: Packages, arguments: dict[str, str]) -> None:
    """Divide what starts between cloud and robot, and make each entry one that a spec accepts."""
    found.robot = [one for one in found.robot if not _timed(found, one)]
    found.cloud = [one for one in found.cloud if not _timed(found, one)]
    if not found.cloud and not found.robot:
        _whole(found, packages, arguments)
    names: set[str] = set()
    found.cloud = [_valid(found, one, names) for one in found.cloud]
    found.robot = [_valid(found, one, names) for one in found.robot]
    names_of = [*of_packages(found), packages.own]
    found.folders = [str(packages.folders[name]) for name in names_of if name in packages.folders]
    if found.said_cloud:
        return
    moving = moving_names(found.robot)
    stay = [(part, reason_of(part, moving)) for one in found.robot for part in _apart(found, one, moving)]
    found.cloud = [one for one, reason in stay if reason is None]
    found.robot = [one for one, reason in stay if reason is not None]
    found.reasons = {id(one): reason for one, reason in stay if reason is not None}
    if not found.cloud:
        each = f"each of its {len(stay)} nodes" if len(stay) > 1 else "its only node"
        said = f"{each} drives, shows, simulates or controls the robot: none is worth a cloud machine"
        found.note(Place(found.path, 1), said)


def _timed(found: LaunchImport, node: dict[str, Any]) -> bool:
    """Whether a node is FogROS2's latency analyser, which becomes the probe."""
    values = node.get("parameters", {})
    if node.get("package") != "fogros2" or "request_topic_name" not in values:
        return False
    found.probe |= {word: values[key] for key, word in PROBE.items() if key in values}
    return True


def _apart(found: LaunchImport, node: dict[str, Any], moving: set[str]) -> list[dict[str, Any]]:
    """Return a container, or two if some of its components move the robot and others do not have to be beside them."""
    parts = node.get(COMPONENTS, [])
    away = [one for one in parts if reason_of(one, moving) is None]
    if not away or not any(why_moving(one, moving) for one in parts):
        return [node]
    name, place = node.get("name", "container"), found.origins[id(node)]
    there = {**node, "name": f"{name}_cloud", COMPONENTS: away}
    node[COMPONENTS], found.origins[id(there)] = [one for one in parts if one not in away], place
    stays = ", ".join(str(one.get("name", one["plugin"])) for one in node[COMPONENTS])
    found.note(place, f"{name} is split: {stays} must stay on the robot, the other components are in {name}_cloud")
    return [node, there]


def _whole(found: LaunchImport, packages: Packages, arguments: dict[str, str]) -> None:
    """Start the launch file itself, where nothing of it could be read."""
    name = os.path.basename(found.path)
    target = [packages.own, name] if packages.own else [name]
    found.cloud.append({"cmd": ["ros2", "launch", *target, *(f"{key}:={value}" for key, value in arguments.items())]})
    found.said_cloud = True
    found.note(Place(found.path, 1), "no node could be read: the spec starts the launch file itself, by ros2 launch")
    for path, lines in found.sources.items():
        for number, text in enumerate(lines, 1):
            if not found.constrained and re.search(r"\bconstraints?\b", text):
                found.constrained = True
                found.note(Place(path, number), UNREADABLE)
                found.constraints |= {"latency": None, "cost": None}


def _valid(found: LaunchImport, node: dict[str, Any], names: set[str]) -> dict[str, Any]:
    """Return the node without what the rules of a spec refuse, each noted."""
    place = found.origins.get(id(node), Place(found.path, 1))
    what = node.get("name") or node.get("executable") or "this process"
    for one in [node, *node.get("composable_node_descriptions", [])]:
        for old, new in list(one.get("remappings", {}).items()):
            if not GRAPH_NAME.fullmatch(old.partition(":=")[0]) or not GRAPH_NAME.fullmatch(new):
                found.note(
                    place, f"the remapping {old}:={new} of {what} is not taken over: ROS 2 does not accept these names"
                )
                del one["remappings"][old]
        if one.get("namespace") and not GRAPH_NAME.fullmatch(one["namespace"]):
            found.note(place, f"the namespace {one['namespace']} of {what} is not taken over: ROS 2 does not accept it")
            del one["namespace"]
        for key in [key for key, value in one.get("parameters", {}).items() if not _parameter(value)]:
            found.note(place, f"the parameter {key} of {what} is not taken over: ROS 2 has no such value")
            del one["parameters"][key]
        for path in [path for path in one.get("parameter_files", []) if not _path(path)]:
            found.note(place, f"the parameter file {path} of {what} is not taken over: it is not in the spec's folder")
            one["parameter_files"].remove(path)
    for name in filter(is_of_graph, list(node.get("env", {}))):
        own = "spec.ros.env or the link sets it"
        found.note(
            place, f"the environment variable {name} of {what} is not taken over: it is of the whole graph; {own}"
        )
        del node["env"][name]
    changed = {key: value for key, value in node.items() if value not in ([], {})}
    full = f"{(node.get('namespace') or '').rstrip('/')}/{node.get('name')}"
    if node.get("name") and "cmd" not in node and full in names and "composable_node_descriptions" not in node:
        if changed.get("launch", {}).pop("autostart", False):
            found.note(place, f"autostart of {what} is not taken over: another node has its name")
        changed = _twin(changed)
    elif node.get("name"):
        names.add(full)
    kept = tidy(changed)
    found.origins[id(kept)] = place
    return kept


def _twin(node: dict[str, Any]) -> dict[str, Any]:
    """Return a node with the name of another one as a process: a spec wants names to differ, and launch does not."""
    argv = ["ros2", "run", node["package"], node["executable"], *node.get("arguments", []), *ros_words(node)]
    return {"cmd": argv, **{key: node[key] for key in ("env", "launch") if key in node}}


def _parameter(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and len({type(one) for one in value}) == 1 and all(map(_parameter, value))
    if isinstance(value, float):
        return value == value and abs(value) != float("inf")
    return isinstance(value, (bool, int, str)) and (not isinstance(value, int) or abs(value) < 2**63)


def _path(path: str) -> bool:
    if path.startswith(("$(find-pkg", "@")):
        return True
    return (
        bool(path) and path[0] not in "/~$" and ":" not in path[:3] and "\\" not in path and Path(path).parts[0] != ".."
    )


def texts(node: Any) -> Iterator[str]:
    """Yield every text in a node."""
    if isinstance(node, str):
        yield node
    elif isinstance(node, dict):
        for one in node.values():
            yield from texts(one)
    elif isinstance(node, list):
        for one in node:
            yield from texts(one)


def of_packages(found: LaunchImport) -> list[str]:
    """Return the packages that what starts comes from, sorted."""
    names: set[str] = set()
    for node in [*found.cloud, *found.robot]:
        names |= {one["package"] for one in [node, *node.get("composable_node_descriptions", [])] if "package" in one}
        for text in texts(node):
            names |= set(re.findall(r"\$\(find-pkg-share ([\w.-]+)\)", text))
    return sorted(names)
