"""Bringing specs to the newest apiVersion: edits at the very places, so that comments, order and spelling stay.

A step leads from one version to the next: keys that got other names, and the version itself. v1alpha1 is the first
version, so there is no step yet; whoever makes the next version adds the step that leads to it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.files import write_bytes
from fogspec.base.yaml.positions import Node, find, key_span, span_of
from fogspec.spec.loader import read_nodes
from fogspec.spec.schema import API_VERSION


@dataclass(frozen=True, slots=True)
class Step:
    """From version `old` to `new`; `renamed` maps the dotted path of a key to the key's new name."""

    old: str
    new: str
    renamed: Mapping[str, str]


STEPS: tuple[Step, ...] = ()


@dataclass(frozen=True, slots=True)
class Migrated:
    """A file's text in the newest version, and the versions that its documents had."""

    path: str
    text: str
    versions: tuple[str, ...]
    changed: bool


def migrate(path: str, steps: Sequence[Step] = STEPS, newest: str = API_VERSION) -> Migrated:
    """The file brought to `newest`; raises DiagnosticError for a version that no step leads on from."""
    nodes, texts = read_nodes(path)
    before = text = "\n".join(texts.lines[path])
    versions: dict[str, None] = {}
    while True:
        edits: list[tuple[Span, str]] = []
        wrong: list[Diagnostic] = []
        for node in nodes:
            version = _version(node)
            versions[version] = None
            if version == newest:
                continue
            step = next((one for one in steps if one.old == version), None)
            if step is None:
                message = f"no step leads from {version or 'no apiVersion'} to {newest}"
                wrong.append(Diagnostic("FS307", message, span_of(node, ("apiVersion",)), f"write '{newest}'"))
            else:
                edits += _edits(node, step)
        if wrong:
            raise DiagnosticError(texts.shown(wrong))
        if not edits:
            return Migrated(path, text, tuple(versions), text != before)
        text = edited(text, edits)
        nodes, texts = read_nodes(path, text.encode())


def _version(node: Node) -> str:
    found = find(node, ("apiVersion",))
    return str(found.value) if found is not None else ""


def write(migrated: Migrated) -> None:
    """Write the file, whole or not at all."""
    write_bytes(Path(migrated.path), migrated.text.encode())


def _edits(node: Node, step: Step) -> list[tuple[Span, str]]:
    edits = [(span_of(node, ("apiVersion",)), step.new)]
    for dotted, name in step.renamed.items():
        place = key_span(node, tuple(dotted.split(".")))
        if place is not None:
            edits.append((place, name))
    return edits


def edited(text: str, edits: Sequence[tuple[Span, str]]) -> str:
    """The text with each place replaced, from the end to the start, so that places stay true."""
    lines = text.split("\n")
    for place, words in sorted(edits, key=lambda edit: (edit[0].line, edit[0].column), reverse=True):
        line = lines[place.line - 1]
        start = place.column - 1
        lines[place.line - 1] = line[:start] + words + line[start + place.width :]
    return "\n".join(lines)
