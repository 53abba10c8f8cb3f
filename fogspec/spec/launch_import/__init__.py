"""Reading ROS 2 launch files without running them: what starts, with which parameters, and what could not be read."""

import os

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.files import read_bounded
from fogspec.base.yaml import reader
from fogspec.spec.launch_import.found import MOST_BYTES, LaunchImport


def read_launch(path: str | os.PathLike[str]) -> LaunchImport:
    """Return what a Python, XML or YAML launch file starts.

    Raise DiagnosticError if the file cannot be read at all; what cannot be imported is in `notes`.
    """
    name = os.fspath(path)
    try:
        content = read_bounded(path, MOST_BYTES)
    except OSError as problem:
        message = f"the launch file cannot be read: {problem.strerror}"
        raise DiagnosticError([Diagnostic("FS801", message, Span(name, 1, 1))]) from None
    text, wrong = reader.decode(content, name)
    if wrong:
        raise DiagnosticError(wrong)
    if name.endswith(".py"):
        from fogspec.spec.launch_import.python import read_python

        return read_python(text, name)
    if name.endswith((".xml", ".launch")):
        from fogspec.spec.launch_import.xml import read_xml

        return read_xml(text, name)
    from fogspec.spec.launch_import.yaml import read_yaml

    return read_yaml(text, name)
