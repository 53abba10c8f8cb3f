"""`compiled/agent.pyz`: the agent as one zip application, reviewed by one digest."""

import io
import zipfile
from collections.abc import Iterator
from functools import cache
from importlib.resources import files

from fogspec.base import digest
from fogspec.spec.probe import PACKAGE

SUFFIXES = (".py", ".c", ".h", ".hpp")
MAIN = f"from {PACKAGE}.__main__ import main\n\nmain()\n".encode()
# User code imports and includes these by their own names.
PROBES = ("fogspec_probe.py", "fogspec_probe.hpp")
# Before it was one file, the agent was copied to `compiled/_agent`; these are the last bytes that fogspec wrote there.
FORMER_FILES = {
    "agent.py": "bad0dd80b43c127db38b03ded76a2f038b47bb9f5c4ff1ce73dbc00b6b6c4b1b",
    "bag.py": "6abb3f7e968d8caf4db57be2ca34b5713c24bd310828d551725725614828c7b3",
    "counting.py": "0e92096d2ff97be657b46edaa04a48b8f1068dec38fdc996ecbc89db678f326e",
    "fogspec_probe.hpp": "2ebe0a53895868eecd99ad13d4a0e7f091cd9ce6c5277bb957b8ffb2f677c5f1",
    "fogspec_probe.py": "8980b94dc2a4a5a2b941de5d4ca1a8d6a3fad4ef35645bdab083e3e9e4f553f6",
    "keeper.py": "a9ae86aa085d32655e2bf28edc4fcf0012ad4b361e95c90e2ed822f8eb60a2bd",
    "pairing.py": "61af08f0d9430b09174d10edb73f9da8137fa0500bf4671ba965af8b2fdc7187",
    "player.py": "d34f1db2be63512ff97a2e58ad44c3afa0217b3da2b7af5b3f9a4f660692bc88",
    "preload.c": "b5ffe591e1200da9c652a192793ee7c8d67c39ecc95f556bd9c6b49ebd6e7d7e",
    "preload.h": "a24bca8cd3907a14afbb4e24d580a4354ec34c990a7720b1d8622689e3037a61",
    "preload.py": "8f53ba0198e2d6b1abc9223430b5af8559d478acd82931a47f44925518be3a15",
    "processes.py": "fb2726945750fca0797ff86d657217711fddbc69101ae0a5b19327f67e87042b",
    "records.py": "24850462a1e371cee7790162f54749c0f3d6d9a87650cdd9bc37c27a7f9b5833",
    "ros.py": "ddf23e90fa65d0f214376431c383da287868d0bbd915c9ee2531ab557aa2c851",
    "secrecy.py": "b16b2ff090c2967b820faa99a4ea91a4c27f503b71233b342b76c06e792c1391",
    "topics.py": "ae9d682537470cf380bb71ca9713c308872a0dee5d08f4078e7c2a8648d3173b",
}


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


def is_former_agent_file(name: str, content: bytes) -> bool:
    """Return whether fogspec itself wrote this file of `compiled/_agent`."""
    return digest.of_bytes(content) == f"sha256:{FORMER_FILES.get(name)}"
