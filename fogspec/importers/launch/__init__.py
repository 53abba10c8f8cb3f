"""What a ROS 2 launch file would start: it runs in a sandbox, against stand-ins of `launch` that record instead of starting."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from fogspec.importers.launch.found import LaunchImport, merged


def read_launch(
    path: str | os.PathLike[str],
    arguments: Mapping[str, str] | None = None,
    package_paths: Sequence[str | os.PathLike[str]] = (),
    *,
    trusted: bool = False,
) -> LaunchImport:
    """Return what a Python, XML or YAML launch file starts with these launch arguments.

    Included files are followed where they are: in the launch file's workspace, below `package_paths`, or installed where
    ROS 2 is sourced. `trusted` runs it also where this machine has no whole sandbox. Raise DiagnosticError if the file cannot
    be read at all; what could not be taken over is in `notes`.
    """
    from fogspec.importers.launch.answer import asked
    from fogspec.importers.launch.packages import Packages
    from fogspec.importers.launch.proposal import propose

    name = os.fspath(path)
    found = LaunchImport(path=name)
    packages = Packages(Path(name), [Path(one) for one in package_paths])
    asked(found, packages, dict(arguments or {}), trusted)
    propose(found, packages, dict(arguments or {}))
    found.notes = merged(found.notes)
    return found
