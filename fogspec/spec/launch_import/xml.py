"""XML launch files, read as data: no entities, no documents from elsewhere."""

import xml.parsers.expat
from typing import Any

from fogspec.spec.launch_import.found import DEEPEST, Place, refuse
from fogspec.spec.launch_import.frontend import Entity, actions, is_ros1


def read_xml(text: str, path: str) -> list[Any]:
    """Return the file's actions; raise DiagnosticError if it is not an XML launch file of ROS 2."""
    try:
        root = _parsed(text, path)
    except xml.parsers.expat.ExpatError as wrong:
        message = f"the launch file must be XML: {xml.parsers.expat.ErrorString(wrong.code)}"
        raise refuse(message, Place(path, wrong.lineno, wrong.offset + 1)) from None
    if root is None or root.tag != "launch":
        raise refuse("the launch file must have one element <launch> and no DOCTYPE", Place(path, 1))
    if is_ros1(root):
        fix = "ROS 2 launch files say exec= for type=, and $(var x) for $(arg x); port it first"
        raise refuse("this is a launch file of ROS 1", root.place, fix)
    return actions(root.inside)


def _parsed(text: str, path: str) -> Entity | None:
    root = Entity("", {}, Place(path, 1))
    stack, refused = [root], []
    parser = xml.parsers.expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        place = Place(path, parser.CurrentLineNumber)
        if len(stack) > DEEPEST:
            raise refuse(f"a launch file may be nested at most {DEEPEST} deep", place)
        element = Entity(tag, dict(attributes), place)
        stack[-1].inside.append(element)
        stack.append(element)

    def doctype(*_: object) -> None:
        refused.append(True)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _tag: stack.pop()
    parser.StartDoctypeDeclHandler = doctype
    if "<!DOCTYPE" not in text and "<!ENTITY" not in text:
        parser.Parse(text, True)
    return root.inside[0] if root.inside and not refused else None
