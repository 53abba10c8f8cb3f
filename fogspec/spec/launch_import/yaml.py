"""YAML launch files."""

from typing import Any

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.yaml import reader
from fogspec.base.yaml.positions import Node
from fogspec.spec.launch_import.found import LaunchImport
from fogspec.spec.launch_import.frontend import Action, take_actions


def read_yaml(text: str, path: str) -> LaunchImport:
    """Return what the file starts; raise DiagnosticError if it is not a YAML launch file."""
    nodes, wrong = reader.documents(text, path)
    if wrong:
        raise DiagnosticError(wrong)
    top = nodes[0].value if len(nodes) == 1 else None
    actions = top.get("launch") if isinstance(top, dict) else None
    if actions is None or not isinstance(actions.value, list):
        message = "the launch file must have a list under 'launch:'"
        raise DiagnosticError([Diagnostic("FS801", message, Span(path, 1, 1))])
    found = LaunchImport(path=path, lines=text.split("\n"))
    take_actions(found, _actions(actions))
    return found


def _actions(node: Node) -> list[Action]:
    """Return the actions of a list of one-key maps."""
    found = []
    for item in node.value if isinstance(node.value, list) else []:
        if isinstance(item.value, dict):
            found += [_action(tag, child, item.keys[tag].line) for tag, child in item.value.items()]
    return found


def _action(tag: str, node: Node, line: int) -> Action:
    attributes: dict[str, Any] = {}
    below: dict[str, list[Action]] = {}
    for key, child in node.value.items() if isinstance(node.value, dict) else ():
        if isinstance(child.value, list):
            below[key] = [_action(key, item, item.span.line) for item in child.value]
        elif not isinstance(child.value, dict):
            attributes[key] = child.value
    return Action(tag, attributes, below, line, _actions(node) if isinstance(node.value, list) else [])
