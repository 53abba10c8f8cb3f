"""Which process a node runs in, how it was started, and what it uses: from /proc, on the robot itself.

eProsima's middleware, which is the default, has the process in each endpoint's identifier (RTPS GUID prefix: vendor 01.0f, two
bytes of the host, two of the process). Otherwise a process is found by `__node:=` on its command line, or by the name of its
executable. A command line may hold a secret: it goes no further than the observations.
"""

import contextlib
import os
import re
from pathlib import Path
from typing import Any

VENDOR = b"\x01\x0f"
INSTALLED = re.compile(r"(?:^|/)lib/(?P<package>[A-Za-z_]\w*)/(?P<executable>[^/]+)$")
MOST_WORDS = 200


class Processes:
    """The processes of nodes, from the time at which each was added."""

    def __init__(self) -> None:
        self.cpu_s: dict[int, float] = {}
        self.found: dict[str, int] = {}
        self.commands: dict[int, list[str]] = {}

    def add(self, gids: dict[str, bytes], own_gid: bytes) -> None:
        """Find the processes of nodes by the identifiers of their endpoints."""
        commands = _commands()
        for node, gid in gids.items():
            pid = _by_gid(gid, own_gid, commands) or _by_words(node, commands)
            if pid is not None:
                self.found[node] = pid
                self.cpu_s.setdefault(pid, _cpu_s(pid))
                self.commands[pid] = commands[pid]

    def of(self, node: str) -> dict[str, Any] | None:
        """Return how a node's process was started, and what it has used since it was added; None if it is not known."""
        pid = self.found.get(node)
        if pid is None:
            return None
        argv = self.commands[pid]
        return {
            **started(argv),
            "argv": argv,
            "shared": sum(other == pid for other in self.found.values()) > 1,
            "cpu_s": max(0.0, _cpu_s(pid) - self.cpu_s[pid]),
            "memory_bytes": _memory_bytes(pid),
        }


def started(argv: list[str]) -> dict[str, Any]:
    """Return package and executable, if it was an installed node, and what follows `--ros-args`."""
    found: dict[str, Any] = {
        "package": None,
        "executable": None,
        "remappings": {},
        "arguments": [],
        "parameter_files": [],
    }
    at = next((i for i, word in enumerate(argv[:2]) if INSTALLED.search(word)), None)
    if at is not None:
        match = INSTALLED.search(argv[at])
        assert match is not None
        found |= {"package": match["package"], "executable": match["executable"]}
    words = iter(argv[(0 if at is None else at) + 1 :])
    ros = False
    for word in words:
        if word == "--ros-args":
            ros = True
        elif ros and word == "--":
            ros = False
        elif not ros:
            found["arguments"].append(word)
        elif word in ("-r", "--remap"):
            name, _, to = next(words, "").partition(":=")
            found["remappings"].setdefault(name, to)  # the first rule for a name is the one that has an effect
        elif word == "--params-file":
            found["parameter_files"].append(next(words, ""))
        elif word in ("-p", "--param", "--log-level", "--log-config-file", "-e", "--enclave"):
            next(words, None)  # parameters are read from the node
    return found


def _commands() -> dict[int, list[str]]:
    found = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            with contextlib.suppress(OSError):
                words = (folder / "cmdline").read_bytes().split(b"\0")[:-1][:MOST_WORDS]
                if words:
                    found[int(folder.name)] = [word.decode("utf-8", "replace") for word in words]
    return found


def _by_gid(gid: bytes, own: bytes, commands: dict[int, list[str]]) -> int | None:
    if gid[:2] != VENDOR or gid[:4] != own[:4]:
        return None
    low = int.from_bytes(gid[4:6], "little")
    fitting = [pid for pid in commands if pid & 0xFFFF == low]
    return fitting[0] if len(fitting) == 1 else None


def _by_words(node: str, commands: dict[int, list[str]]) -> int | None:
    name = node.rpartition("/")[2]
    for words in ((f"__node:={name}", f"__name:={name}"), (name,)):
        fitting = [pid for pid, argv in commands.items() if _fits(argv, words)]
        if len(fitting) == 1:
            return fitting[0]
    return None


def _fits(argv: list[str], words: tuple[str, ...]) -> bool:
    if len(words) == 2:
        return any(word in argv for word in words)
    return any((match := INSTALLED.search(word)) and match["executable"] == words[0] for word in argv[:2])


def _cpu_s(pid: int) -> float:
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _memory_bytes(pid: int) -> int | None:
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return None
