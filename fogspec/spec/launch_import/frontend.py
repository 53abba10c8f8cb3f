"""What XML and YAML launch files have in common: the actions of ROS 2's launch front ends."""

import re
from dataclasses import dataclass
from typing import Any

from fogspec.spec.launch_import.found import LaunchImport, tidy_node, typed, words

VARIABLE = re.compile(r"\$\((?:var|arg)\s+([\w./-]+)\s*\)")
SUBSTITUTION = re.compile(r"\$\(")


@dataclass(frozen=True)
class Action:
    """One action: its attributes, the actions under it by name, and all of them in order."""

    tag: str
    attributes: dict[str, Any]
    below: dict[str, list["Action"]]
    line: int
    inside: list["Action"]


def take_actions(found: LaunchImport, actions: list[Action]) -> None:
    """Import what starts; all nodes go to the robot, because these files cannot say otherwise."""
    defaults: dict[str, str] = {}
    _take(found, actions, defaults)


def _take(found: LaunchImport, actions: list[Action], defaults: dict[str, str]) -> None:
    for action in actions:
        found.spend(0)
        if action.tag in ("arg", "let"):
            value = action.attributes.get("default", action.attributes.get("value"))
            if value is not None:
                defaults[str(action.attributes.get("name"))] = str(value)
        elif action.tag == "node":
            _node(found, action, defaults)
        elif action.tag == "executable":
            argv = words(str(_text(found, action, "cmd", defaults) or ""))
            if argv:
                found.robot.append({"cmd": argv})
        elif action.tag == "group":
            found.note(action.line, "a group's scope is not taken over, its nodes are")
            _take(found, action.inside, defaults)
        else:
            found.note(action.line, f"{action.tag} is not taken over")


def _node(found: LaunchImport, action: Action, defaults: dict[str, str]) -> None:
    def text(of: Action, name: str) -> str | None:
        return _text(found, of, name, defaults)

    raw: dict[str, Any] = {
        "package": text(action, "pkg"),
        "executable": text(action, "exec"),
        "name": text(action, "name"),
        "namespace": text(action, "namespace"),
        "arguments": words(text(action, "args") or ""),
    }
    if action.attributes.keys() & {"if", "unless"}:
        found.note(action.line, "a condition decides whether this node starts: taken as if it does")
    for one in action.below.get("remap", []):
        if (source := text(one, "from")) and (target := text(one, "to")):
            raw.setdefault("remappings", {})[source] = target
    for one in action.below.get("env", []):
        if (name := text(one, "name")) and (value := text(one, "value")) is not None:
            raw.setdefault("env", {})[name] = value
    parameters = _parameters(found, action.below.get("param", []), defaults, raw)
    if parameters:
        raw["parameters"] = parameters
    if raw["package"] and raw["executable"]:
        found.robot.append(tidy_node(raw))
    else:
        found.note(action.line, "a node without a readable package and executable is left out")


def _parameters(
    found: LaunchImport, params: list[Action], defaults: dict[str, str], raw: dict[str, Any]
) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for one in params:
        if "from" in one.attributes:
            path = _text(found, one, "from", defaults)
            if path:
                raw.setdefault("parameter_files", []).append(path)
        elif one.below.get("param"):
            parameters[str(one.attributes.get("name"))] = _parameters(found, one.below["param"], defaults, raw)
        else:
            value = one.attributes.get("value")
            known = _text(found, one, "value", defaults) if isinstance(value, str) else value
            if known is not None and "name" in one.attributes:
                parameters[str(one.attributes["name"])] = typed(known) if isinstance(known, str) else known
    return parameters


def _text(found: LaunchImport, action: Action, name: str, defaults: dict[str, str]) -> str | None:
    """Return an attribute with the defaults of launch arguments filled in; None if only launching determines it."""
    value = action.attributes.get(name)
    if value is None:
        return None

    def default_of(variable: re.Match[str]) -> str:
        default = defaults.get(variable[1], variable[0])
        found.spend(len(default))
        return default

    text = VARIABLE.sub(default_of, str(value))
    found.spend(len(text))
    if text != str(value):
        found.note(action.line, f"{name}: the defaults of launch arguments are taken")
    if SUBSTITUTION.search(text):
        found.note(action.line, f"{name} is only known when the file is launched: not taken over")
        return None
    return text
