"""Files that a sample printed into its job's log, between markers, which works on every infra.

The log comes from another machine and is untrusted: it is read line by line, with limits for lines and files.
"""

import contextlib
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fogspec.backends import agent_state
from fogspec.backends.protocol import Partial
from fogspec.base.project_files import ProjectFiles

LOG_LIMIT = 256 * 2**20
LINE_LIMIT = 2**20
# SkyPilot's prefix of each line: the task's name and process, in color.
PREFIX = re.compile(rb"^(?:\x1b\[[0-9;]*m)*\([^()\n]{0,200}pid=\d+[^()\n]{0,100}\)(?:\x1b\[[0-9;]*m)* ?")
MARKER = re.compile(rb"^=== fogspec (begin|end) (outcome\.json|packages\.txt|timings\.jsonl) ===\s*$")
TIMINGS = b"timings.jsonl"
MEASURES = b"=== fogspec measures ==="
SO_FAR = re.compile(rb"=== fogspec so far: (\d{1,12}) requests(?:, mean ([0-9.e+-]{1,24}) s)? ===")
READ_BYTES = 2**20
# The kernel's words, Slurm's, those of Ray's monitor (docs.ray.io, "Out-Of-Memory Prevention"), which runs beside the job, and
# those of a compiler.
OOM = re.compile(
    rb"oom[-_ ]kill|out of memory|killed due to (?:the node running low on memory|memory pressure)"
    rb"|Killed signal terminated program",
    re.IGNORECASE,
)
TAIL_BYTES = 16 * 2**10


def unpack(files: ProjectFiles, log: Path, folder: Path) -> bool:
    """Write the files in the log to `folder`, the last of each name; return whether the timings are complete.

    Timings without an end are kept: their lines were measured.
    """
    part = folder / "part"
    name, out, whole = b"", None, False
    try:
        for line in _lines(files, log):
            marker = MARKER.match(line)
            if marker is None:
                if out is not None:
                    out.write(line)
                continue
            if out is not None:
                out.close()
                if marker[1] == b"end" and marker[2] == name:
                    files.move(part, folder / name.decode())
                    whole = name == TIMINGS
            out, name = (files.create(part), marker[2]) if marker[1] == b"begin" else (None, b"")
    finally:
        if out is not None:
            out.close()
            if name == TIMINGS:
                files.move(part, folder / name.decode())
        files.remove(part)
    return whole


@dataclass(frozen=True, slots=True)
class LogTail:
    """The state of a growing log after `read_to` bytes: whether set-up is over, and the sample's progress."""

    read_to: int = 0
    ready: bool = False
    so_far: Partial | None = None


def read_log(files: ProjectFiles, log: Path, before: LogTail) -> LogTail:
    """Return the state after the new whole lines."""
    with contextlib.suppress(OSError), files.open(log) as file:
        file.seek(before.read_to)
        new = file.read(READ_BYTES)
        # A line that is longer than one read is skipped.
        whole = new.rfind(b"\n") + 1 or (len(new) if len(new) == READ_BYTES else 0)
        reports = SO_FAR.findall(new[:whole])
        so_far = _so_far(*reports[-1]) if reports else before.so_far
        return LogTail(before.read_to + whole, before.ready or MEASURES in new[:whole], so_far)
    return before


def _so_far(requests: bytes, mean: bytes) -> Partial | None:
    with contextlib.suppress(ValueError):
        mean_s = float(mean) if mean else None
        if mean_s is None or 0 <= mean_s < math.inf:
            return Partial(int(requests), mean_s)
    return None


def _lines(files: ProjectFiles, log: Path) -> Iterator[bytes]:
    read = 0
    with files.open(log) as file:
        while read < LOG_LIMIT and (line := file.readline(LINE_LIMIT)):
            read += len(line)
            yield PREFIX.sub(b"", line)


def last_line(files: ProjectFiles, log: Path) -> str:
    """Return the last line that tells why the job ended; empty if there is none."""
    return agent_state.last_line(_tail(files, log)) or ""


def measures(files: ProjectFiles, log: Path) -> bool:
    """Return whether set-up was over, and the nodes were to be started."""
    with contextlib.suppress(OSError):
        return any(line.startswith(MEASURES) for line in _lines(files, log))
    return False


def out_of_memory(files: ProjectFiles, log: Path) -> bool:
    """Return whether the log ends with a process that was killed for lack of memory."""
    return OOM.search(_tail(files, log)) is not None


def _tail(files: ProjectFiles, log: Path) -> bytes:
    with contextlib.suppress(OSError), files.open(log) as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
        return file.read(TAIL_BYTES)
    return b""
