"""A recorder in place of ROS 2's `launch` and `launch_ros`, which are not on PyPI: it keeps what a launch file makes.

Keyword arguments are checked against those that the real actions take (launch 1.0 of Humble to 3.x of Lyrical).
"""

import contextlib
import logging
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PROCESS = {
    "cmd",
    "cwd",
    "additional_env",
    "output",
    "on_exit",
    "respawn",
    "respawn_delay",
    "name",
    "env",
    "shell",
    "prefix",
}
KEYWORDS = {
    "ExecuteProcess": PROCESS,
    "Node": PROCESS - {"cmd"}
    | {"package", "executable", "namespace", "parameters", "remappings", "arguments", "exec_name"},
    "SetEnvironmentVariable": {"name", "value"},
    "Shutdown": {"reason"},
    "LogInfo": {"msg"},
    "OpaqueFunction": {"function"},
}


class Entity:
    """What the launch file made: which action, with which words."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        if type(self).__name__ in KEYWORDS:
            unknown = keywords.keys() - KEYWORDS[type(self).__name__]
            if unknown:
                raise TypeError(f"{type(self).__name__} takes no {unknown}")
        self.kind, self.arguments, self.keywords = type(self).__name__, arguments, keywords
        if self.kind == "Node":
            self.node_package, self.node_executable = keywords["package"], keywords["executable"]
        if self.kind == "ExecuteProcess":
            self.cmd = [[types.SimpleNamespace(text=word)] for word in keywords["cmd"]]

    def visit(self, context: Any) -> list[Any] | None:
        return None


class LaunchDescription:
    def __init__(self, entities: list[Any] = ()) -> None:
        self.entities = list(entities)

    def started(self) -> list[Entity]:
        """Every action that starts, what entities return when they are visited put in their place."""
        return [one for entity in self.entities for one in _visited(entity)]


def _visited(entity: Any) -> Iterator[Entity]:
    below = entity.visit(None)
    if below is None:
        yield entity
    else:
        for one in below:
            yield from _visited(one)


@contextlib.contextmanager
def recorder() -> Iterator[None]:
    """The recorder can be imported as `launch` and `launch_ros` for the length of a block."""
    names = {
        "launch": {"LaunchDescription": LaunchDescription, "LaunchDescriptionEntity": Entity},
        "launch.actions": {name: type(name, (Entity,), {}) for name in KEYWORDS if name != "Node"},
        "launch.logging": {"get_logger": logging.getLogger},
        "launch_ros": {},
        "launch_ros.actions": {name: type(name, (Entity,), {}) for name in ("Node", "ComposableNodeContainer")},
        "launch_ros.descriptions": {"ComposableNode": type("ComposableNode", (Entity,), {})},
        "launch_ros.parameter_descriptions": {
            name: type(name, (Entity,), {}) for name in ("ParameterFile", "ParameterValue")
        },
        "launch_ros.substitutions": {
            name: type(name, (Entity,), {}) for name in ("FindPackagePrefix", "FindPackageShare")
        },
        "launch.substitutions": {name: type(name, (Entity,), {}) for name in ("Command", "EnvironmentVariable")},
    }
    for name, content in names.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(content)
    try:
        yield
    finally:
        for name in [*names, *(name for name in sys.modules if name.startswith("fogspec.ros"))]:
            sys.modules.pop(name, None)


def launched(path: Path) -> list[Entity]:
    """What the launch file at `path` starts."""
    with recorder():
        scope: dict[str, Any] = {"__file__": str(path), "__name__": "launch_file"}
        exec(compile(path.read_text("utf-8"), str(path), "exec"), scope)
        description = scope["generate_launch_description"]()
        return description.started()
