"""A YAML document as a tree of values that know where they stand."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from fogspec.base.diagnostics import Span

Path = tuple[str | int, ...]
Scalar = str | int | float | bool | None


@dataclass(slots=True)
class Node:
    """A value and its place; `keys` are the places of a mapping's keys, `text` how a scalar was written.

    `empty` marks a value that is not there at all (`key:`), `quoted` a text in quotes or in a block.
    """

    value: "Scalar | dict[str, Node] | list[Node]"
    place: Span
    keys: dict[str, Span] = field(default_factory=dict)
    text: str = ""
    quoted: bool = False
    empty: bool = False
    size: int = 1

    def children(self) -> "Iterator[tuple[str | int, Node]]":
        """The key or index of each value in a mapping or list."""
        if isinstance(self.value, dict):
            yield from self.value.items()
        elif isinstance(self.value, list):
            yield from enumerate(self.value)


def plain(node: Node) -> Any:
    """The values alone: dicts, lists and scalars."""
    if isinstance(node.value, dict):
        return {key: plain(child) for key, child in node.value.items()}
    if isinstance(node.value, list):
        return [plain(child) for child in node.value]
    return node.value


def find(node: Node, path: Path) -> Node | None:
    """The node at a path, or None."""
    for step in path:
        found: Node | None = None
        if isinstance(node.value, dict) and isinstance(step, str):
            found = node.value.get(step)
        elif isinstance(node.value, list) and isinstance(step, int) and 0 <= step < len(node.value):
            found = node.value[step]
        if found is None:
            return None
        node = found
    return node


def key_span(node: Node, path: Path) -> Span | None:
    """Where the key that ends the path is written; None for an item of a list or a path that is not there."""
    parent = find(node, path[:-1]) if path else None
    return parent.keys.get(str(path[-1])) if parent else None


def span_of(node: Node, path: Path) -> Span:
    """What to underline for a path: the value where it is a scalar, its key where it is a block of lines.

    For a path that is not there, the nearest thing around it that is.
    """
    found = find(node, path)
    if found is None:
        return span_of(node, path[:-1])
    if path and (isinstance(found.value, (dict, list)) or found.empty):
        return key_span(node, path) or found.place
    return found.place


def places(node: Node) -> dict[Path, Span]:
    """What to underline for every path in the document."""
    found: dict[Path, Span] = {(): node.place}

    def walk(parent: Node, path: Path) -> None:
        for step, child in parent.children():
            whole = isinstance(child.value, (dict, list)) or child.empty
            key = parent.keys.get(step) if isinstance(step, str) else None
            found[(*path, step)] = key if whole and key else child.place
            walk(child, (*path, step))

    walk(node, ())
    return found


def dotted(path: Path) -> str:
    """`spec.cloud[0].package`."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text
