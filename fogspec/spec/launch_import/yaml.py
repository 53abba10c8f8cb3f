"""YAML launch files."""

from typing import Any

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.yaml import reader
from fogspec.base.yaml.positions import Node
from fogspec.spec.launch_import.found import DEEPEST, Place, refuse
from fogspec.spec.launch_import.frontend import Entity, actions


def read_yaml(text: str, path: str) -> list[Any]:
    """Return the file's actions; raise DiagnosticError if it is not a YAML launch file."""
    nodes, wrong = reader.documents(text, path)
    if wrong:
        raise DiagnosticError(wrong)
    top = nodes[0].value if len(nodes) == 1 else None
    listed = top.get("launch") if isinstance(top, dict) else None
    if listed is None or not isinstance(listed.value, list):
        raise refuse("the launch file must have a list under 'launch:'", Place(path, 1))
    return actions(_entities(listed, path, 0))


def _entities(node: Node, path: str, depth: int) -> list[Entity]:
    """Return the entities of a list of maps with one key each."""
    found = []
    for item in node.value if isinstance(node.value, list) else []:
        if isinstance(item.value, dict):
            found += [_entity(tag, child, Place(path, item.keys[tag].line), depth) for tag, child in item.value.items()]
    return found


def _entity(tag: str, node: Node, place: Place, depth: int) -> Entity:
    if depth > DEEPEST:
        raise refuse(f"a launch file may be nested at most {DEEPEST} deep", place)
    entity = Entity(tag, {}, place)
    if isinstance(node.value, list):
        entity.inside = _entities(node, place.path, depth + 1)
    for key, child in node.value.items() if isinstance(node.value, dict) else ():
        if key == "children":
            entity.inside += _entities(child, place.path, depth + 1)
        elif isinstance(child.value, list) and any(isinstance(one.value, dict) for one in child.value):
            entity.inside += [_entity(key, one, Place(place.path, one.span.line), depth + 1) for one in child.value]
        elif isinstance(child.value, list):
            entity.attributes[key] = [one.value for one in child.value]
        elif not isinstance(child.value, dict):
            entity.attributes[key] = child.value
    return entity
