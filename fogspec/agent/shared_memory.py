"""Shared memory files that a workload leaves behind: a node that is killed does not remove its own.

Only what processes of the workload were seen to use is removed: others may put files in the same folder meanwhile. A file that
no process has open any more when it is looked for stays.
"""

import contextlib
import os
import re
import stat
from collections.abc import Callable, Iterable
from pathlib import Path

FOLDER = Path("/dev/shm")  # noqa: S108
MOST_FILES = 1000
MAPPED = re.compile(r" (/dev/shm/[^/\n]+)$", re.MULTILINE)
MAPS_BYTES = 2**22


class SharedMemory:
    """The files that appear in `FOLDER` from now on and belong to a workload."""

    def __init__(self) -> None:
        self.before = _files()
        self.seen = set(self.before)
        self.own: dict[str, int] = {}
        self.changed_ns = 0

    def look(self, pids: Callable[[], Iterable[int]], again: bool = False) -> None:
        """Take the files that these processes use, if any file has appeared since the last look, or `again`."""
        changed_ns = _changed_ns()
        if changed_ns == self.changed_ns and not again:
            return
        self.changed_ns = changed_ns
        found = {name: inode for name, inode in _files().items() if self.before.get(name) != inode}
        new = {name for name in found if name not in self.own and (again or name not in self.seen)}
        self.seen.update(found)
        if new:
            used = _used(pids())
            room = MOST_FILES - len(self.own)
            self.own.update({name: found[name] for name in sorted(new & used)[:room]})

    def remove(self) -> None:
        """Remove the files that were taken and that no process uses any more."""
        if not self.own:
            return
        used = _used(int(entry) for entry in os.listdir("/proc") if entry.isdigit())
        now = _files()
        for name, inode in self.own.items():
            if now.get(name) == inode and name not in used:
                with contextlib.suppress(OSError):
                    os.unlink(FOLDER / name)
        self.own.clear()


def _changed_ns() -> int:
    try:
        return os.stat(FOLDER).st_mtime_ns
    except OSError:
        return 0


def _files() -> dict[str, int]:
    """Return the inodes of this user's plain files."""
    found = {}
    with contextlib.suppress(OSError), os.scandir(FOLDER) as entries:
        for entry in entries:
            with contextlib.suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                if stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid():
                    found[entry.name] = status.st_ino
    return found


def _used(pids: Iterable[int]) -> set[str]:
    """Return the names of the files that these processes have open or mapped."""
    found: set[str] = set()
    for pid in pids:
        with contextlib.suppress(OSError), open(f"/proc/{pid}/maps", encoding="utf-8", errors="replace") as maps:
            found.update(MAPPED.findall(maps.read(MAPS_BYTES)))
        with contextlib.suppress(OSError):
            for handle in os.listdir(f"/proc/{pid}/fd"):
                with contextlib.suppress(OSError):
                    found.add(os.readlink(f"/proc/{pid}/fd/{handle}"))
    return {Path(path).name for path in found if path.startswith(f"{FOLDER}/")}
