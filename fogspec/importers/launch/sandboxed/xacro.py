"""xacro as launch files call it: a robot's description is what the command makes of the file on the machine."""

from typing import Any

from fogspec.importers.launch.sandboxed.context import perform
from fogspec.importers.launch.sandboxed.values import Unknown, kept, plain


class Document:
    """What xacro makes of a file."""

    def __init__(self, path: Any, mappings: dict[str, Any] | None = None) -> None:
        self.path, self.mappings = path, dict(mappings or {})

    def toxml(self, *_: Any, **__: Any) -> str:
        """Return the command that makes it."""
        words = "".join(f" {key}:={plain(perform(value))}" for key, value in self.mappings.items())
        return kept(f"$(command 'xacro {plain(perform(self.path))}{words}')")

    toprettyxml = toxml

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return Unknown(f"only the machine has what xacro makes of {plain(perform(self.path))}")


def _process_doc(document: Document, mappings: dict[str, Any] | None = None, **_: Any) -> None:
    document.mappings |= mappings or {}


NAMES: dict[str, Any] = {
    "process_file": lambda input_file_name, mappings=None, **_: Document(input_file_name, mappings),
    "process": lambda input_file_name, mappings=None, **_: Document(input_file_name, mappings).toxml(),
    "parse": lambda file, *_: Document(getattr(file, "name", file)),
    "process_doc": _process_doc,
    "open_output": lambda *_: None,
}
