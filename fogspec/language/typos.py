"""Error recovery: misspelt and misplaced keys are moved where they belong, so that their values are checked too.

Each such key is an error. Repairing it keeps one error from causing others.
"""

import difflib
from dataclasses import dataclass, field
from typing import Any

from fogspec.base.diagnostics import Diagnostic, Span
from fogspec.base.yaml.positions import Node, Path, dotted, find
from fogspec.language.introspect import annotation_at, fields_of, home_of, part
from fogspec.language.suggest import EITHER, closest, is_synonym

CLOSE = 0.8


@dataclass
class Repaired:
    """The repaired document, its errors, the paths that stay unknown, and the parents of the keys that were moved."""

    node: Node
    wrong: list[Diagnostic] = field(default_factory=list)
    broken: set[Path] = field(default_factory=set)
    meant: set[Path] = field(default_factory=set)


def repair(model: Any, node: Node) -> Repaired:
    """Return the document without `x-` keys in mappings of the schema, and with every known key where it belongs."""
    repairer = _Repairer(model)
    found = Repaired(repairer.walk(model, node, ()), repairer.wrong, repairer.broken)
    for home, key_span, child in repairer.moved:
        _graft(found.node, home, key_span, repairer.walk(annotation_at(model, home), child, home))
        found.meant |= {home[:length] for length in range(1, len(home) + 1)}
    return found


class _Repairer:
    def __init__(self, model: Any) -> None:
        self.model = model
        self.wrong: list[Diagnostic] = []
        self.broken: set[Path] = set()
        self.moved: list[tuple[Path, Span, Node]] = []

    def walk(self, annotation: Any, node: Node, path: Path) -> Node:
        if isinstance(node.value, list):
            items = part(annotation)[1]
            return self._like(node, [self._item(items, child, (*path, i)) for i, child in enumerate(node.value)])
        if not isinstance(node.value, dict):
            return node
        fields = fields_of(annotation)
        return self._known(fields, node, path) if fields else self._free(part(annotation)[1], node, path)

    def _like(self, node: Node, value: Any, keys: dict[str, Span] | None = None) -> Node:
        return Node(value=value, span=node.span, keys=keys or {}, size=node.size)

    def _item(self, items: Any, child: Node, path: Path) -> Node:
        if child.empty:
            self._empty(child.span, path, "remove the '-', or give it a value")
        return self.walk(items, child, path)

    def _free(self, items: Any, node: Node, path: Path) -> Node:
        """Walk a mapping whose keys are the user's own."""
        values: dict[str, Node] = {}
        for key, child in node.value.items() if isinstance(node.value, dict) else ():
            if child.empty:
                self._empty(node.keys[key], (*path, key))
            else:
                values[key] = self.walk(items, child, (*path, key))
        return self._like(node, values, node.keys)

    def _known(self, fields: dict[str, Any], node: Node, path: Path) -> Node:
        """Walk a mapping of the schema."""
        values: dict[str, Node] = {}
        keys: dict[str, Span] = {}
        empty: dict[str, Span] = {}
        above = ""
        present = set(node.value) if isinstance(node.value, dict) else set()
        for key, child in node.value.items() if isinstance(node.value, dict) else ():
            span = node.keys[key]
            if key.startswith("x-"):
                continue
            name: str | None = key
            if key not in fields and above in empty and key in fields_of(fields[above]):
                keys.setdefault(above, empty[above])
                parent = values.setdefault(above, Node(value={}, span=empty[above]))
                self._indent(parent, (*path, above, key), span, child)
                continue
            if key not in fields:
                name = self._meant((*path, key), span, fields, present | set(values), child)
            if name is None:
                continue
            above = name
            if child.empty:
                empty[name] = span
            else:
                values[name], keys[name] = self.walk(fields[name], child, (*path, name)), span
        for name, span in empty.items():
            if name not in values:
                self._empty(span, (*path, name))
        return self._like(node, values, keys)

    def _indent(self, parent: Node, at: Path, span: Span, child: Node) -> None:
        """Put a key under its `parent`, at whose level it was written; report it."""
        key = str(at[-1])
        message = f"{key} must be indented under {dotted(at[:-1])}"
        fix = f"indent it by {max(2, parent.span.column + 2 - span.column)} spaces, with the lines that belong to it"
        self.wrong.append(Diagnostic("FS116", message, span, fix))
        if isinstance(parent.value, dict) and not child.empty:
            parent.value[key] = self.walk(annotation_at(self.model, at), child, at)
            parent.keys[key] = span

    def _meant(self, at: Path, span: Span, fields: dict[str, Any], present: set[str], child: Node) -> str | None:
        """Return the field that the key at `at` was meant to be, if it is one of this mapping's; report the error."""
        key, path = str(at[-1]), at[:-1]
        name = closest(key, [one for one in fields if one not in present])
        home = home_of(self.model, key, path)
        if home is not None and fields_of(annotation_at(self.model, home)) and not isinstance(child.value, dict):
            home = None  # another field of the same name, with fields below it
        is_close = name is not None and (
            is_synonym(key, name) or difflib.SequenceMatcher(None, key, name).ratio() >= CLOSE
        )
        if name is not None and home is not None and key in EITHER:
            fix, name = f"move it to '{dotted(home)}', or write '{name}' if you mean that", None
        elif name is not None and (home is None or is_close):
            fix = f"write '{name}'"
        elif home is not None:
            fix = f"move it to '{dotted(home)}'"
            self.moved.append((home, span, child))
            name = None
        elif twin := closest(key, fields):
            fix, name = f"'{twin}' is there already: remove one of the two", None
        else:
            fix, name = f"known here: {', '.join(fields)}; a key of your own starts with 'x-'", None
        self.wrong.append(Diagnostic("FS301", f"{dotted(at)} is not a field of the spec", span, fix))
        return name

    def _empty(self, span: Span, path: Path, fix: str = "remove the key, or give it a value") -> None:
        self.wrong.append(Diagnostic("FS115", f"{dotted(path)} has no value", span, fix))
        self.broken.add(path)


def _graft(root: Node, home: Path, key_span: Span, child: Node) -> None:
    """Put a value where it belongs, unless another value is there or a parent is not a mapping."""
    node = root
    for step in home[:-1]:
        if not isinstance(node.value, dict) or not isinstance(step, str):
            return
        node.keys.setdefault(step, key_span)
        node = node.value.setdefault(step, Node(value={}, span=key_span))
    last = home[-1]
    if isinstance(node.value, dict) and isinstance(last, str) and find(node, (last,)) is None and not child.empty:
        node.value[last], node.keys[last] = child, key_span
