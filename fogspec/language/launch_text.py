"""Texts of nodes with launch's own substitutions, which only the machine that starts the node can replace."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from fogspec.language.schema import ComposableNode, Node

CLASSES = {
    "find-pkg-share": ("launch_ros.substitutions", "FindPackageShare"),
    "find-pkg-prefix": ("launch_ros.substitutions", "FindPackagePrefix"),
    "env": ("launch.substitutions", "EnvironmentVariable"),
    "command": ("launch.substitutions", "Command"),
}
STARTS = tuple(f"$({name} " for name in CLASSES)


@dataclass(frozen=True, slots=True)
class Substitution:
    """One of launch's substitutions: its word in launch files, and what it is given."""

    name: str
    given: str


def has_substitution(text: str) -> bool:
    """Return whether a text has a substitution that launch replaces where the node starts."""
    return any(isinstance(one, Substitution) for one in parts(text))


def parts(text: str) -> list[str | Substitution]:
    """Return the texts and substitutions that a text is made of."""
    found: list[str | Substitution] = []
    plain, at = 0, 0
    while (at := text.find("$(", at)) >= 0:
        start = next((one for one in STARTS if text.startswith(one, at)), None)
        end = _end(text, at + 2) if start else -1
        if start is None or end < 0:
            at += 2
            continue
        given = text[at + len(start) : end].strip()
        if len(given) > 1 and given[0] == given[-1] and given[0] in "'\"":
            given = given[1:-1]
        found += [text[plain:at]] if at > plain else []
        found.append(Substitution(start[2:-1], given))
        plain = at = end + 1
    return [*found, text[plain:]] if plain < len(text) or not found else found


def _end(text: str, at: int) -> int:
    depth = 1
    for place in range(at, len(text)):
        depth += {"(": 1, ")": -1}.get(text[place], 0)
        if depth == 0:
            return place
    return -1


def texts(node: Node | ComposableNode) -> Iterator[str]:
    """Yield every text of a node in which a substitution may be."""
    yield from _texts(node.model_dump(mode="json", exclude_defaults=True))


def has_allowed(node: Node | ComposableNode) -> bool:
    """Return whether launch replaces substitutions in the parameter files."""
    return (node.launch if isinstance(node, Node) else node).allow_substs


def needs_launch(node: Node) -> bool:
    """Return whether only launch itself can start a node: a container of components, or one with substitutions."""
    return bool(node.composable_node_descriptions) or has_allowed(node) or any(map(has_substitution, texts(node)))


def imports(nodes: list[Node]) -> dict[str, set[str]]:
    """Return the names of substitutions that launch files with these nodes import, by module."""
    found: dict[str, set[str]] = {}

    def add(text: str) -> None:
        for one in parts(text):
            if isinstance(one, Substitution):
                module, name = CLASSES[one.name]
                found.setdefault(module, set()).add(name)
                add(one.given)

    for node in nodes:
        for text in texts(node):
            add(text)
    return found


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for one in value.values():
            yield from _texts(one)
    elif isinstance(value, list):
        for one in value:
            yield from _texts(one)
