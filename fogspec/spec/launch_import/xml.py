"""XML launch files, read as data: no entities, no documents from elsewhere."""

import xml.parsers.expat
from dataclasses import dataclass, field

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.spec.launch_import.found import LaunchImport
from fogspec.spec.launch_import.frontend import Action, take_actions


@dataclass
class _Element:
    tag: str
    attributes: dict[str, str]
    line: int
    children: list["_Element"] = field(default_factory=list)


def read_xml(text: str, path: str) -> LaunchImport:
    """Return what the file starts; raise DiagnosticError if it is not an XML launch file."""
    found = LaunchImport(path=path, lines=text.split("\n"))
    try:
        root = _parsed(text, found)
    except xml.parsers.expat.ExpatError as wrong:
        message = f"the launch file must be XML: {xml.parsers.expat.ErrorString(wrong.code)}"
        raise DiagnosticError([Diagnostic("FS801", message, Span(path, wrong.lineno, wrong.offset + 1))]) from None
    if root is None or root.tag != "launch":
        message = "the launch file must have one element <launch> and no DOCTYPE"
        raise DiagnosticError([Diagnostic("FS801", message, Span(path, 1, 1))])
    take_actions(found, [_action(child) for child in root.children])
    return found


def _parsed(text: str, found: LaunchImport) -> _Element | None:
    root = _Element("", {}, 0)
    stack, refused = [root], []
    parser = xml.parsers.expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        found.checked_depth(len(stack), parser.CurrentLineNumber)
        element = _Element(tag, attributes, parser.CurrentLineNumber)
        stack[-1].children.append(element)
        stack.append(element)

    def doctype(*_: object) -> None:
        refused.append(True)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _tag: stack.pop()
    parser.StartDoctypeDeclHandler = doctype
    if "<!DOCTYPE" not in text and "<!ENTITY" not in text:
        parser.Parse(text, True)
    return root.children[0] if root.children and not refused else None


def _action(element: _Element) -> Action:
    """Return the element as the YAML front end would write it: children of one name are a list."""
    inside = [_action(child) for child in element.children]
    below: dict[str, list[Action]] = {}
    for child in inside:
        below.setdefault(child.tag, []).append(child)
    return Action(element.tag, dict(element.attributes), below, element.line, inside)
