"""Which nodes belong on the robot, by a list of packages and programs with a reason each (ADR 0142)."""

import os.path
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import cache
from typing import Any


def reason_of(node: Mapping[str, Any]) -> str | None:
    """Return why a node belongs on the robot; None if nothing says so."""
    groups, commands = _listed()
    if "cmd" in node:
        argv = node["cmd"]
        if argv[:1] == ["ros2"] and len(argv) > 2 and argv[1] in ("launch", "run"):
            return _reason(groups, argv[2])
        return _reason(commands, os.path.basename(argv[0]))
    said = [node.get("package", ""), *(one["package"] for one in node.get("composable_node_descriptions", []))]
    return next((reason for one in said if (reason := _reason(groups, one)) is not None), None)


def _reason(groups: list[tuple[str, list[str]]], name: str) -> str | None:
    return next((reason for reason, patterns in groups if any(fnmatchcase(name, one) for one in patterns)), None)


@cache
def _listed() -> tuple[list[tuple[str, list[str]]], list[tuple[str, list[str]]]]:
    import tomllib
    from importlib.resources import files

    data = tomllib.loads(files(__package__).joinpath("robot_packages.toml").read_text("utf-8"))
    return (
        [(one["reason"], one["packages"]) for one in data["group"]],
        [(one["reason"], one["programs"]) for one in data["command"]],
    )
