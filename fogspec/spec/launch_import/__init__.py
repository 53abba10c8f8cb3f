"""Reading ROS 2 launch files without running them: what `launch` would start, and what could not be read."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from fogspec.spec.launch_import.found import LaunchImport, merged


def read_launch(
    path: str | os.PathLike[str],
    arguments: Mapping[str, str] | None = None,
    package_paths: Sequence[str | os.PathLike[str]] = (),
) -> LaunchImport:
    """Return what a Python, XML or YAML launch file starts with these launch arguments.

    Included files are followed where they are: in the launch file's workspace, below `package_paths`, or installed where
    ROS 2 is sourced. Raise DiagnosticError if the file cannot be read at all; what could not be taken over is in `notes`.
    """
    from fogspec.spec.launch_import.packages import Packages
    from fogspec.spec.launch_import.proposal import propose
    from fogspec.spec.launch_import.service import Service

    name = os.fspath(path)
    found = LaunchImport(path=name)
    packages = Packages(Path(name), [Path(one) for one in package_paths])
    Service(found, packages, dict(arguments or {})).play(name)
    propose(found, packages, dict(arguments or {}))
    found.notes = merged(found.notes)
    return found
