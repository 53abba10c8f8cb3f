"""Overlays: a spec merged with partial specs. Maps merge, lists whose items have names merge by name, others replace."""

from collections.abc import Sequence

from fogspec.base.yaml.positions import Node, find


def merge(node: Node, overlays: Sequence[Sequence[Node]]) -> Node:
    """Return the document merged with every overlay that applies to it, later ones on top.

    An overlay's document with a `metadata.name` applies to the application of that name, one without to all.
    """
    name = find(node, ("metadata", "name"))
    for documents in overlays:
        for overlay in documents:
            meant = find(overlay, ("metadata", "name"))
            if meant is None or (name is not None and meant.value == name.value):
                node = _over(node, overlay)
    return node


def _over(below: Node, above: Node) -> Node:
    if isinstance(below.value, dict) and isinstance(above.value, dict):
        values = dict(below.value)
        for key, child in above.value.items():
            values[key] = _over(values[key], child) if key in values else child
        keys = {key: above.keys.get(key) or below.keys[key] for key in values}
        return Node(value=values, span=below.span, keys=keys, size=below.size + above.size)
    if isinstance(below.value, list) and isinstance(above.value, list) and _named(below) and _named(above):
        return Node(value=_by_name(below.value, above.value), span=below.span, size=below.size + above.size)
    return above


def _named(node: Node) -> bool:
    """Return whether every item of a list is a map with a name."""
    items = node.value if isinstance(node.value, list) else []
    return bool(items) and all(_name(item) is not None for item in items)


def _name(item: Node) -> str | None:
    found = find(item, ("name",))
    return found.value if found and isinstance(found.value, str) else None


def _by_name(below: list[Node], above: list[Node]) -> list[Node]:
    over = {_name(item): item for item in above}
    merged = [_over(item, over.pop(_name(item))) if _name(item) in over else item for item in below]
    return merged + [item for item in above if _name(item) in over]
