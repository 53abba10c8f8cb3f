"""The packages of the machine: what its set-up installed that day. One line each: kind, name, version.

Names of files are listed, and no program runs: nothing here can hang, or runs code that a node left.
"""

import base64
import contextlib
import os
import re
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

from .machine_facts import read_text

DPKG = Path("/var/lib/dpkg/status")
MOST_PACKAGES, MOST_S = 20_000, 3.0
MOST_BYTES = 2**20
WORD = r"[A-Za-z0-9][A-Za-z0-9.+:~_/@!^-]{0,127}"
LINE = re.compile(rf"(dpkg|pip|conda|module) {WORD} {WORD}")


def listed(dpkg: Path = DPKG) -> str:
    """Return the list, sorted, one package per line; empty if this machine has no list of any kind."""
    until_s, found = time.monotonic() + MOST_S, set[str]()
    for kind, name, version in _all(dpkg):
        if LINE.fullmatch(line := f"{kind} {name} {version}"):
            found.add(f"{line}\n")
        if len(found) == MOST_PACKAGES or time.monotonic() > until_s:
            return ""  # part of a list would differ from every other
    text = "".join(sorted(found))
    return text if len(text) <= MOST_BYTES else ""


def packed(text: str) -> str:
    """Return the list as a word for a line of a log."""
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode()


def _all(dpkg: Path) -> Iterator[tuple[str, str, str]]:
    for part in read_text(dpkg, 16 * MOST_BYTES).split("\n\n"):
        fields = dict(re.findall(r"^(Package|Status|Version): (.*)$", part, re.MULTILINE))
        if fields.get("Status", "").endswith(" installed"):
            yield "dpkg", fields.get("Package", ""), fields.get("Version", "")
    for folder in dict.fromkeys(sys.path):
        for name in _names(folder, (".dist-info", ".egg-info")):
            package, _, version = name.rpartition(".")[0].partition("-")
            yield "pip", package, version.partition("-py")[0]
    for name in _names(os.path.join(os.environ.get("CONDA_PREFIX", ""), "conda-meta"), (".json",)):
        package, version, build = (["", "", *name.removesuffix(".json").rsplit("-", 2)])[-3:]
        yield "conda", package, f"{version}_{build}"
    # As `module list` prints them.
    for module in filter(None, os.environ.get("LOADEDMODULES", "").split(":")):
        name, _, version = module.partition("/")
        yield "module", name, version or "default"


def _names(folder: str, endings: tuple[str, ...]) -> Iterator[str]:
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        yield from (entry.name for entry in entries if entry.name.endswith(endings))
