"""A first spec: valid, commented from the language's own field pages, with a line for the editor."""

import os.path
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fogspec.base.text import line as one_line
from fogspec.base.yaml.writer import block
from fogspec.importers.launch.found import WRITTEN, LaunchImport
from fogspec.language.field_docs import FieldPage, pages
from fogspec.language.rules.benchmark import PLACEHOLDER_PACKAGE, PLACEHOLDER_TOPICS
from fogspec.language.rules.machines import OFFICIAL_IMAGE, lacks
from fogspec.language.schema import API_VERSION, Application

ADVANCED = "  # advanced fields: fogspec explain spec\n"
COLUMN = 48
WORKSPACE = "ros2_ws"


def workspace_of(paths: Sequence[str], folder: Path) -> tuple[str, list[str]]:
    """Return the colcon workspace of packages or programs below the spec's folder; otherwise the usual one and what to copy."""
    for path in paths:
        parts = Path(path).parts
        at = max((i for i, part in enumerate(parts) if part in ("src", "install")), default=0)
        if at and not (inside := os.path.relpath(Path(*parts[:at]), folder)).startswith(".."):
            return inside, []
    shown = [os.path.relpath(path, folder) for path in paths[:1]]
    return WORKSPACE, [
        f"{one} is sent to no machine: copy its package into {WORKSPACE}/src beside this spec." for one in shown
    ]


def first_data(name: str, found: LaunchImport | None = None, workspace: str = WORKSPACE) -> dict[str, Any]:
    """Return the values of a first spec, taken from a launch file if there is one."""
    cloud: list[dict[str, Any]] = [{"package": PLACEHOLDER_PACKAGE, "executable": "my_node"}]
    robot: list[dict[str, Any]] = [{"package": PLACEHOLDER_PACKAGE, "executable": "my_client"}]
    if found is not None:
        folder = f"{name}.params"
        cloud, robot = ([_placed(one, folder) for one in side] for side in (found.cloud, found.robot))
    spec: dict[str, Any] = {"cloud": cloud}
    if robot:
        spec["robot"] = robot
    built = any("package" in one or one["cmd"][0] == "ros2" for one in cloud or robot)
    infra = (found and found.infra) or ["aws/us-east-1"]
    ros = {"workspace": workspace if built else None, "image": found and found.image, "setup": found and found.setup}
    spec["ros"] = with_image({"distro": "jazzy", **{key: value for key, value in ros.items() if value}}, infra)
    spec["probe"] = dict(zip(("request", "response"), PLACEHOLDER_TOPICS, strict=True)) | (found.probe if found else {})
    spec["constraints"] = {"latency": "1s", "cost": "$0.001/request"}
    spec["objective"] = {"alpha": 0.5}
    spec["hardware"] = {"cpus": "2..64", "memory": "4GiB..512GiB", "gpus": ["none"]}
    spec["infra"] = infra
    spec["benchmark"] = {"budget": "$2.50"}
    if cloud and robot:
        spec["connectivity"] = {"link": "zenoh"}
    if found is None:
        spec["benchmark"]["workload"] = {"node": robot[0]}
    else:
        _over(spec, found)
    return {"apiVersion": API_VERSION, "kind": "Application", "metadata": {"name": name}, "spec": spec}


def with_image(ros: dict[str, Any], infra: Sequence[str]) -> dict[str, Any]:
    """Return a ROS 2 environment with its distribution's own image, if it names none and machines there cannot do without."""
    distro = ros["distro"]
    if "image" in ros or not any(lacks(distro, place) for place in infra):
        return ros
    return {"distro": distro, "image": OFFICIAL_IMAGE.format(distro), **ros}


def _over(spec: dict[str, Any], found: LaunchImport) -> None:
    """Replace what a first spec proposes by what the launch file has."""
    if found.constrained:
        spec["constraints"] = found.constraints
    if not spec["constraints"]:
        del spec["constraints"]
    spec["objective"] |= found.objective
    spec["hardware"] |= found.hardware
    if found.stop:
        spec["benchmark"]["stop"] = found.stop


def _placed(value: Any, folder: str) -> Any:
    """Return a value with the files that launch would write in the folder beside the spec."""
    if isinstance(value, dict):
        return {key: _placed(one, folder) for key, one in value.items()}
    if isinstance(value, list):
        return [_placed(one, folder) for one in value]
    return value.replace(WRITTEN, f"{folder}/") if isinstance(value, str) else value


def first_text(data: dict[str, Any], schema: str, notes: list[str], found: LaunchImport | None = None) -> str:
    """Return the spec as text: each field's meaning after its first line, and where advanced fields are explained.

    Above a node of a launch file is where it is written, and why it is proposed for the robot.
    """
    book = {page.path: page for page in pages(Application)}
    lines = [f"# yaml-language-server: $schema={one_line(schema)}", *(f"# {one_line(note)}" for note in notes)]
    said: set[str] = set()
    origins = _origins(found)
    for written, path in block(data):
        # A field without a value is an error, where null means no limit.
        line = written.removesuffix(" null") if written.endswith(": null") else written
        if len(path) == 4 and path[1:3] in origins and line.lstrip().startswith("- "):
            lines.append(f"{' ' * (len(line) - len(line.lstrip()))}# {one_line(origins[path[1:3]])}")
        page = _page(book, path)
        meaning = page.meaning if page and page.path not in said else ""
        if page:
            said.add(page.path)
        lines.append(f"{line:<{COLUMN}} # {meaning}" if meaning else line)
    return "\n".join(line.rstrip() for line in lines) + f"\n{ADVANCED}"


def _origins(found: LaunchImport | None) -> dict[tuple[str | int, ...], str]:
    """Return the comment of each node, by its side and number."""
    comments: dict[tuple[str | int, ...], str] = {}
    if found is None:
        return comments
    for side in ("cloud", "robot"):
        for i, node in enumerate(found.cloud if side == "cloud" else found.robot):
            place, reason = found.origins.get(id(node)), found.reasons.get(id(node))
            where = f"{os.path.basename(place.path)}:{place.line}" if place else ""
            comments[(side, i)] = f"{where}: proposed for the robot, because it {reason}" if reason else where
    return {key: text for key, text in comments.items() if text}


def _page(book: dict[str, FieldPage], path: tuple[str | int, ...]) -> FieldPage | None:
    text = "".join("[]" if isinstance(step, int) else f".{step}" for step in path).lstrip(".")
    return book.get(text)


def name_from(text: str) -> str:
    """Return an application's name made from the name of a file or directory."""
    stem = re.sub(r"(\.launch)?(\.sky)?\.(py|xml|ya?ml|launch)$", "", text.lower())
    return re.sub(r"[^a-z0-9]+", "-", stem).strip("-")[:63].strip("-") or "my-application"
