"""A spec that is valid, of what a launch file starts: which nodes stay on the robot, and what a spec has no words for."""

import json
import os.path
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fogspec.spec.launch_import.fogros import timed_node
from fogspec.spec.launch_import.found import LaunchImport, Place
from fogspec.spec.launch_import.nodes import tidy
from fogspec.spec.launch_import.packages import Packages
from fogspec.spec.robot_packages import reason_of
from fogspec.spec.rules.nodes import GRAPH_NAME


def propose(found: LaunchImport, packages: Packages, arguments: dict[str, str]) -> None:
    """Divide what starts between cloud and robot, and make each entry one that a spec accepts."""
    found.robot = [one for one in found.robot if not timed_node(found, one)]
    found.cloud = [one for one in found.cloud if not timed_node(found, one)]
    if not found.cloud and not found.robot:
        _whole(found, packages, arguments)
    names: set[str] = set()
    found.cloud = [_valid(found, one, names) for one in found.cloud]
    found.robot = [_valid(found, one, names) for one in found.robot]
    if found.said_cloud:
        return
    stay = [(one, reason_of(one)) for one in found.robot]
    if all(reason for _, reason in stay):
        found.cloud, found.robot = found.robot, []
        return
    found.cloud = [one for one, reason in stay if reason is None]
    found.robot = [one for one, reason in stay if reason is not None]
    found.reasons = {id(one): reason for one, reason in stay if reason is not None}


def _whole(found: LaunchImport, packages: Packages, arguments: dict[str, str]) -> None:
    """Start the launch file itself, where nothing of it could be read."""
    name = os.path.basename(found.path)
    target = [packages.own, name] if packages.own else [name]
    found.cloud.append({"cmd": ["ros2", "launch", *target, *(f"{key}:={value}" for key, value in arguments.items())]})
    found.said_cloud = True
    found.note(Place(found.path, 1), "no node could be read: the spec starts the launch file itself, by ros2 launch")


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
    changed = {key: value for key, value in node.items() if value not in ([], {})}
    full = f"{(node.get('namespace') or '').rstrip('/')}/{node.get('name')}"
    if node.get("name") and "cmd" not in node and full in names and "composable_node_descriptions" not in node:
        changed = _twin(changed)
    elif node.get("name"):
        names.add(full)
    kept = tidy(changed)
    found.origins[id(kept)] = place
    return kept


def _twin(node: dict[str, Any]) -> dict[str, Any]:
    """Return a node with the name of another one as a process: a spec wants names to differ, and launch does not."""
    argv = ["ros2", "run", node["package"], node["executable"], *node.get("arguments", []), "--ros-args"]
    argv += ["-r", f"__node:={node['name']}"]
    if node.get("namespace"):
        argv += ["-r", f"__ns:={node['namespace']}"]
    for path in node.get("parameter_files", []):
        argv += ["--params-file", path]
    for key, value in node.get("parameters", {}).items():
        argv += ["-p", f"{key}:={json.dumps(value, ensure_ascii=False)}"]
    for source, target in node.get("remappings", {}).items():
        argv += ["-r", f"{source}:={target}"]
    return {"cmd": argv, **{key: node[key] for key in ("env", "respawn", "respawn_delay") if key in node}}


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
