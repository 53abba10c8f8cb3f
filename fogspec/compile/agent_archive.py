"""`compiled/agent.pyz`: the agent as one zip application, reviewed by one digest."""

import io
import zipfile
from collections.abc import Iterator
from functools import cache
from importlib.resources import files

from fogspec.language.probe import PACKAGE

SUFFIXES = (".py", ".c", ".h", ".hpp")
MAIN = f"from {PACKAGE}.__main__ import main\n\nmain()\n".encode()
# User code imports and includes these by their own names.
PROBES = ("fogspec_probe.py", "fogspec_probe.hpp")


@cache
def agent_archive() -> bytes:
    """Return the zip application: the same bytes on every machine and Python version for the same sources.

    Members are sorted, stored without compression (its bytes depend on zlib's version) and have a fixed time.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in sorted(_members()):
            member = zipfile.ZipInfo(name)
            member.create_system = 3  # Unix, on every platform
            member.external_attr = 0o100644 << 16
            archive.writestr(member, content)
    return buffer.getvalue()


def _members() -> Iterator[tuple[str, bytes]]:
    yield "__main__.py", MAIN
    for source in files("fogspec.agent").iterdir():
        if source.name.endswith(SUFFIXES):
            name = source.name if source.name in PROBES else f"{PACKAGE}/{source.name}"
            yield name, source.read_bytes()
