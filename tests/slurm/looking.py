"""What others on this host can see of a bench: command lines, ports, files that all may write; and what is kept of it."""

import base64
import contextlib
import gzip
import os
import pwd
import re
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from tests.tools.slurm import login

EVERY_S = 1.0
LISTENING = {"tcp": "0A", "tcp6": "0A", "udp": "07", "udp6": "07"}
# What fogspec starts on a machine; the programs that SkyPilot starts have all of the task among their words.
OURS = re.compile(rb"[^\0]*python3?\0[^\0]*/(agent\.pyz|work\.py)\0|[^\0]*python3?\0work\.py\0")


@dataclass
class Looking:
    """A thread that looks until it is left; `secret` is what no command line may have.

    `told` has the first words of those that did, `ports` who listened where: the program, and whether it is fogspec's
    or what fogspec started; `writable` are files below a home of a node that everybody may write.
    """

    secret: str
    told: set[str] = field(default_factory=set)
    ports: set[tuple[str, bool]] = field(default_factory=set)
    writable: set[str] = field(default_factory=set)
    looks: int = 0
    seen: set[str] = field(default_factory=set)
    _over: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def __enter__(self) -> "Looking":
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        assert self._thread is not None
        self._thread.join()

    def _run(self) -> None:
        user = pwd.getpwnam(login.USER)
        while not self._over.wait(EVERY_S):
            self.looks += 1
            ours = self._commands(user.pw_uid)
            self._sockets(ours)
            self._files(Path(user.pw_dir) / ".sky_clusters")

    def _commands(self, uid: int) -> dict[int, tuple[str, bool]]:
        """The user's processes and ours: what they are called, and whether they are ours; looks at everybody's words."""
        found = {}
        for entry in filter(str.isdigit, os.listdir("/proc")):
            with contextlib.suppress(OSError):
                words = Path("/proc", entry, "cmdline").read_bytes()
                if self.secret.encode() in words:
                    self.told.add(words[:60].replace(b"\0", b" ").decode("utf-8", "replace"))
                ours = OURS.match(words) is not None
                if ours or os.stat(f"/proc/{entry}").st_uid == uid:
                    skylet = b"sky.skylet.skylet" in words
                    name = "skylet" if skylet else Path("/proc", entry, "comm").read_text().strip()
                    name = os.path.basename(os.fsdecode(words.split(b"\0")[1])) if ours else name
                    found[int(entry)] = name, ours
                    if ours:
                        self.seen.add(name)
        return found

    def _sockets(self, processes: dict[int, tuple[str, bool]]) -> None:
        listening: dict[str, set[str]] = {}
        for pid, told in processes.items():
            with contextlib.suppress(OSError):
                net = os.readlink(f"/proc/{pid}/ns/net")
                if net not in listening:
                    listening[net] = listened(pid)
                for name in os.listdir(f"/proc/{pid}/fd"):
                    if os.readlink(f"/proc/{pid}/fd/{name}") in listening[net]:
                        self.ports.add(told)

    def _files(self, homes: Path) -> None:
        for folder in homes.glob("*/.fogspec"):
            for at, _, names in os.walk(folder):
                for name in (at, *(os.path.join(at, one) for one in names)):
                    with contextlib.suppress(OSError):
                        if os.lstat(name).st_mode & 0o002 and not os.path.islink(name):
                            self.writable.add(name)


def listened(pid: int) -> set[str]:
    """The sockets that are listened on where a process is."""
    found = set()
    for kind, state in LISTENING.items():
        with contextlib.suppress(OSError):
            for line in Path("/proc", str(pid), "net", kind).read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == state:
                    found.add(f"socket:[{fields[9]}]")
    return found


def holding(paths: Iterable[Path], secret: str) -> list[str]:
    """Which of these files have it: as it is, compressed, or in base64, as SkyPilot's database has its requests."""
    forms = [secret.encode()]
    for before in range(3):
        # Characters that are the same whatever stands before and after.
        forms.append(base64.b64encode(bytes(before) + secret.encode())[before and 4 : -4])
    found = []
    for path in paths:
        with contextlib.suppress(OSError):
            if path.is_file() and not path.is_symlink():
                content = path.read_bytes()
                content = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
                found += [str(path)] if any(form in content for form in forms) else []
    return found
