"""Misspelt and misplaced keys, put where they were meant: so that what stands behind them is checked all the same.

A document with one of these mistakes is wrong, and each is said; mending it keeps one mistake from causing others.
"""

import difflib
from dataclasses import dataclass, field
from typing import Any

from fogspec.base.diagnostics import Diagnostic, Span
from fogspec.base.yaml.positions import Node, Path, dotted, find
from fogspec.spec.introspect import annotation_at, fields_of, home_of, part
from fogspec.spec.schema import Application
from fogspec.spec.suggest import closest

CLOSE = 0.8
RENAMED: dict[Path, str] = {
    ("spec", "constraints", "network"): "network_allowance",
    ("spec", "objective", "interruption", "restart"): "recovery_time",
    ("spec", "benchmark", "wave"): "batch_size",
    ("spec", "benchmark", "stop", "steps"): "requests",
    ("spec", "benchmark", "stop", "after"): "duration",
    ("spec", "benchmark", "setup"): "setup_timeout",
    ("spec", "benchmark", "valid"): "min_success_rate",
    ("spec", "deployment", "patience"): "ready_timeout",
}


@dataclass
class Repaired:
    """The document as it was meant, what was wrong, the paths that stay unknown, and those that mended keys belong to."""

    node: Node
    wrong: list[Diagnostic] = field(default_factory=list)
    broken: set[Path] = field(default_factory=set)
    meant: set[Path] = field(default_factory=set)


def repair(model: Any, node: Node) -> Repaired:
    """The document without `x-` keys of the language's mappings, and with every known key in its place."""
    mender = _Repairer(model)
    found = Repaired(mender.walk(model, node, ()), mender.wrong, mender.broken)
    for home, key_place, child in mender.moved:
        _graft(found.node, home, key_place, mender.walk(annotation_at(model, home), child, home))
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
        return Node(value, node.place, keys or {}, size=node.size)

    def _item(self, items: Any, child: Node, path: Path) -> Node:
        if child.empty:
            self._empty(child.place, path, "remove the '-', or give it a value")
        return self.walk(items, child, path)

    def _free(self, items: Any, node: Node, path: Path) -> Node:
        """A mapping whose keys are the user's own."""
        values: dict[str, Node] = {}
        for key, child in node.value.items() if isinstance(node.value, dict) else ():
            if child.empty:
                self._empty(node.keys[key], (*path, key))
            else:
                values[key] = self.walk(items, child, (*path, key))
        return self._like(node, values, node.keys)

    def _known(self, fields: dict[str, Any], node: Node, path: Path) -> Node:
        """A mapping of the language."""
        values: dict[str, Node] = {}
        keys: dict[str, Span] = {}
        empty: dict[str, Span] = {}
        above = ""
        present = set(node.value) if isinstance(node.value, dict) else set()
        for key, child in node.value.items() if isinstance(node.value, dict) else ():
            place = node.keys[key]
            if key.startswith("x-"):
                continue
            name: str | None = key
            if key not in fields and above in empty and key in fields_of(fields[above]):
                self._indent(above, key, place, path, values, keys, empty, child)
                continue
            if key not in fields:
                name = self._renamed(key, place, path, fields, present | set(values), child)
            if name is None:
                continue
            above = name
            if child.empty:
                empty[name] = place
            else:
                values[name], keys[name] = self.walk(fields[name], child, (*path, name)), place
        for name, place in empty.items():
            if name not in values:
                self._empty(place, (*path, name))
        return self._like(node, values, keys)

    def _indent(
        self, above: str, key: str, place: Span, path: Path, values: dict[str, Node], keys: dict[str, Span],
        empty: dict[str, Span], child: Node,
    ) -> None:  # fmt: skip
        """A key that stands at the level of the key that it belongs to."""
        at = (*path, above, key)
        message = f"{key} must be indented under {dotted((*path, above))}"
        self.wrong.append(Diagnostic("FS116", message, place, "indent it, with all that belongs to it"))
        adopted = values.setdefault(above, Node({}, empty[above]))
        keys.setdefault(above, empty[above])
        if isinstance(adopted.value, dict) and not child.empty:
            adopted.value[key] = self.walk(annotation_at(self.model, at), child, at)
            adopted.keys[key] = place

    def _renamed(
        self, key: str, place: Span, path: Path, fields: dict[str, Any], present: set[str], child: Node
    ) -> str | None:
        """The field that a key was meant to be, if it is one of this mapping's; says what is wrong."""
        if renamed := RENAMED.get((*path, key)) if self.model is Application else None:
            return self._was_renamed(key, renamed, place, path, present)
        name = closest(key, [one for one in fields if one not in present])
        home = home_of(self.model, key, path)
        sure = name is not None and difflib.SequenceMatcher(None, key, name).ratio() >= CLOSE
        if name is not None and (home is None or sure):
            fix = f"write '{name}'"
        elif home is not None:
            fix = f"move it to '{dotted(home)}'"
            self.moved.append((home, place, child))
            name = None
        elif twin := closest(key, fields):
            fix, name = f"'{twin}' is there already: remove one of the two", None
        else:
            fix, name = f"known here: {', '.join(fields)}; a key of your own starts with 'x-'", None
        self.wrong.append(Diagnostic("FS301", f"{dotted((*path, key))} is not a field of the language", place, fix))
        return name

    def _was_renamed(self, key: str, name: str, place: Span, path: Path, present: set[str]) -> str | None:
        """Return the current name of a key that had another one, or None if both are set; report it."""
        message = f"{dotted((*path, key))} was renamed to {dotted((*path, name))}"
        twice = name in present
        fix = f"remove it: '{name}' is there already" if twice else f"write '{name}'"
        self.wrong.append(Diagnostic("FS308", message, place, fix))
        return None if twice else name

    def _empty(self, place: Span, path: Path, fix: str = "remove the key, or give it a value") -> None:
        self.wrong.append(Diagnostic("FS115", f"{dotted(path)} has no value", place, fix))
        self.broken.add(path)


def _graft(root: Node, home: Path, key_place: Span, child: Node) -> None:
    """Put a value where it belongs, unless something stands there or the way there is closed."""
    node = root
    for step in home[:-1]:
        if not isinstance(node.value, dict) or not isinstance(step, str):
            return
        node.keys.setdefault(step, key_place)
        node = node.value.setdefault(step, Node({}, key_place))
    last = home[-1]
    if isinstance(node.value, dict) and isinstance(last, str) and find(node, (last,)) is None and not child.empty:
        node.value[last], node.keys[last] = child, key_place
