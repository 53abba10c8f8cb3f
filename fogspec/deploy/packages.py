"""Packages, kernel and driver of the machine that serves, against those of the machine that was measured.

A difference is a warning and makes nothing stale: set-up installs what its sources have that day.
"""

from collections.abc import Sequence

from fogspec.agent.packages import MOST_BYTES
from fogspec.backends.protocol import DeploymentStatus
from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import Layout
from fogspec.base.text import count, shell_command
from fogspec.deploy.schema import DeployedMachine
from fogspec.results.io import read_results
from fogspec.results.packages import checked, differences


def packages_differ(layout: Layout, machine: DeployedMachine, live: DeploymentStatus | None) -> list[str]:
    """Return the differences of packages, kernel and driver from the measured machine of its type that is most like it.

    None for a type that was not measured, or where a list is missing.
    """
    if live is None or live.server is None or live.packages is None:
        return []
    try:
        results = read_results(layout)
        samples = [] if results is None else results.spec.samples
        servers = [one.server for one in samples if one.server and one.machine.type_key == machine.machine.type_key]
        measured = [(one, text) for one in servers if (text := _packages(layout, one.packages)) is not None]
    except (DiagnosticError, FogspecError, OSError):
        return []
    return min((differences(one, (live.server, live.packages)) for one in measured), key=len, default=[])


def packages_text(name: str, found: Sequence[str]) -> list[str]:
    """Return a warning that names the first difference, and where the others are; nothing without one."""
    others = f", {count(len(found) - 1, 'other')} ({shell_command('fogspec', 'status', name, '-v')})"
    return [f"packages differ from the measured machine's: {found[0]}{others if found[1:] else ''}"] if found else []


def _packages(layout: Layout, named: str | None) -> str | None:
    """Return the list of packages with this digest; None if it is missing or was changed."""
    if named is None or not layout.files.is_file(path := layout.packages(named)):
        return None
    text = checked(layout.files.read(path, MOST_BYTES))
    return text if text is not None and digest.of_bytes(text.encode()) == named else None
