"""What a launch file starts, in the words of the spec, and what of it could not be read."""

import json
import re
import string
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span

MOST_BYTES = 256 << 10  # of a launch file
MOST_DATA_BYTES = 1 << 20  # of a file that one reads
WORDS = (
    "package", "executable", "plugin", "cmd", "name", "namespace", "parameters", "parameter_files", "remappings", "arguments",
    "extra_arguments", "allow_substs", "autostart", "env", "launch", "composable_node_descriptions", "place",
)  # fmt: skip
WRITTEN = "@files/"  # where a file that launch would write is put, in front of its name
MOST_NAMED = 8  # things or lines in one note
# Where packages are taken to be installed: below the first root, what goes up from one is seen to have lost it. The others are
# like those of machines; what differs below them depends on the machine. `*`: each package has a prefix of its own.
ROOTS = (
    "/.fogspec" * 4 + "/*", "/opt/ros/jazzy-", "/home/ubuntu/ros2_ws-/install/*",
    f"/workspaces/isaac_ros-dev/{string.ascii_letters}{string.digits}/a/long/and/deep/one/with/all/the/letters/install-",
)  # fmt: skip
COMPUTED = "it is computed from the path of a package, which only the machine knows"


@dataclass(frozen=True, slots=True)
class Place:
    """Where something is written."""

    path: str
    line: int
    column: int = 1
    width: int = 1


def tidy(raw: dict[str, Any]) -> dict[str, Any]:
    """Return a node with its keys in the order of the schema, without empty ones."""
    return {word: raw[word] for word in WORDS if raw.get(word) not in (None, "", [], {}, False)}


def ros_words(node: dict[str, Any]) -> list[str]:
    """Return what `ros2 run` is given for a node behind its own arguments."""
    argv = ["--ros-args"]
    argv += ["-r", f"__node:={node['name']}"] if node.get("name") else []
    argv += ["-r", f"__ns:={node['namespace']}"] if node.get("namespace") else []
    for path in node.get("parameter_files", []):
        argv += ["--params-file", path]
    for key, value in node.get("parameters", {}).items():
        argv += ["-p", f"{key}:={json.dumps(value, ensure_ascii=False)}"]
    for source, target in node.get("remappings", {}).items():
        argv += ["-r", f"{source}:={target}"]
    return argv


@dataclass(kw_only=True)
class Started:
    """What would start, in the words of the spec, and what FogROS2's classes give: what the sandboxed process answers.

    `constrained` says whether it has constraints, so that none is proposed. `files` are parameter files that the launch file
    writes while it is played, by their names beside the spec. `defaults` are the launch arguments whose default was taken, with
    the value.
    """

    cloud: list[dict[str, Any]] = field(default_factory=list)
    robot: list[dict[str, Any]] = field(default_factory=list)
    said_cloud: bool = False
    constrained: bool = False
    constraints: dict[str, Any] = field(default_factory=dict)
    objective: dict[str, Any] = field(default_factory=dict)
    hardware: dict[str, Any] = field(default_factory=dict)
    stop: dict[str, Any] = field(default_factory=dict)
    probe: dict[str, Any] = field(default_factory=dict)
    infra: list[str] = field(default_factory=list)
    image: str | None = None
    setup: list[str] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)
    defaults: dict[str, str] = field(default_factory=dict)
    included: list[str] = field(default_factory=list)


@dataclass(kw_only=True)
class LaunchImport(Started):
    """What the spec can take over, and warnings about the rest.

    `folders` are those of packages. `origins` and `reasons` are by the id() of a node: where it is written, and why it is
    proposed for the robot.
    """

    path: str
    reasons: dict[int, str] = field(default_factory=dict)
    origins: dict[int, Place] = field(default_factory=dict)
    folders: list[str] = field(default_factory=list)
    notes: list[Diagnostic] = field(default_factory=list)
    sources: dict[str, list[str]] = field(default_factory=dict)
    noted: set[tuple[str, int, str]] = field(default_factory=set)

    def note(self, place: Place, message: str) -> None:
        """Report once what was not taken over, and where it is."""
        key = (place.path, place.line, message)
        if key in self.noted:
            return
        self.noted.add(key)
        lines = self.sources.get(place.path, [])
        source = lines[place.line - 1] if 0 < place.line <= len(lines) else ""
        column, width = place.column, place.width
        if column == 1:
            column = len(source) - len(source.lstrip()) + 1
        if width == 1:
            width = max(1, len(source.rstrip()) - column + 1)
        span = Span(place.path, place.line, column, width)
        self.notes.append(Diagnostic("FS802", message, span, severity="warning", source_line=source))


NOT_TAKEN = re.compile(r"(?P<what>.*?) (?:is|are) not taken over: (?P<why>.*)", re.DOTALL)


def merged(notes: Sequence[Diagnostic]) -> list[Diagnostic]:
    """Return one note for all that one reason keeps out of one file, at the first of its lines."""
    groups: dict[tuple[str, str, bool], list[Diagnostic]] = {}
    for note in notes:
        match = NOT_TAKEN.fullmatch(note.message)
        groups.setdefault((note.span.path, match["why"] if match else note.message, match is not None), []).append(note)
    return [_one(group, why if is_taken else None) for (_, why, is_taken), group in groups.items()]


def _one(notes: Sequence[Diagnostic], why: str | None) -> Diagnostic:
    first = notes[0]
    lines = list(dict.fromkeys(str(note.span.line) for note in notes))[1:]
    also = f" (also in line{'s' * (len(lines) > 1)} {_listed(lines)})" if lines else ""
    named = (NOT_TAKEN.fullmatch(note.message) for note in notes)
    of_nodes: dict[str, dict[str, None]] = {}
    for what in (match["what"] for match in named if match):
        thing, _, node = what.rpartition(" of ")
        of_nodes.setdefault(node if thing else "", {})[thing or what] = None
    some = [_listed([*things]) + (f" of {node}" if node else "") for node, things in of_nodes.items()]
    is_one = why is None or sum(map(len, of_nodes.values())) == 1
    message = first.message if is_one else f"{_listed(some)} are not taken over: {why}"
    return replace(first, message=f"{message}{also}")


def _listed(words: Sequence[str]) -> str:
    if len(words) > MOST_NAMED + 1:
        return f"{', '.join(words[:MOST_NAMED])} and {len(words) - MOST_NAMED} more"
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def refuse(message: str, place: Place, fix: str | None = None) -> DiagnosticError:
    """Return the error of a launch file that cannot be read at all."""
    return DiagnosticError([Diagnostic("FS801", message, Span(place.path, place.line, place.column), fix)])
