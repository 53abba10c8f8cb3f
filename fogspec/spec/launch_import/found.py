"""What a launch file says, as far as it can be read without running it."""

import shlex
from dataclasses import dataclass, field
from typing import Any

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.yaml.scalars import Refusal, resolve

MOST_BYTES = 256 << 10
MOST_WORK = 20_000_000  # characters that are handled to read one file
DEEPEST = 50
LONGEST_COMMAND = 8 << 10
NODE_WORDS = (
    "package",
    "executable",
    "cmd",
    "name",
    "namespace",
    "parameters",
    "parameter_files",
    "remappings",
    "arguments",
    "env",
)


@dataclass(kw_only=True)
class LaunchImport:
    """Nodes as the spec writes them, whatever else a spec can take over, and warnings about the rest."""

    path: str
    lines: list[str]
    cloud: list[dict[str, Any]] = field(default_factory=list)
    robot: list[dict[str, Any]] = field(default_factory=list)
    constraints: dict[str, Any] = field(default_factory=dict)
    objective: dict[str, Any] = field(default_factory=dict)
    hardware: dict[str, Any] = field(default_factory=dict)
    stop: dict[str, Any] = field(default_factory=dict)
    setup: list[str] = field(default_factory=list)
    notes: list[Diagnostic] = field(default_factory=list)
    work: int = 0

    def spend(self, characters: int) -> None:
        """Count work; raise DiagnosticError once it is out of proportion: a few names can double a text many times."""
        self.work += 16 + characters
        if self.work > MOST_WORK:
            message = "the launch file is too large, or its values grow too large when they are put together"
            fix = "write the spec by hand: fogspec init without --from-launch"
            raise DiagnosticError([Diagnostic("FS801", message, Span(self.path, 1, 1), fix)])

    def checked_depth(self, depth: int, line: int) -> None:
        """Raise DiagnosticError for what is nested too deep."""
        if depth > DEEPEST:
            message = f"a launch file may be nested at most {DEEPEST} deep"
            raise DiagnosticError([Diagnostic("FS801", message, Span(self.path, line, 1))])

    def note(self, line: int, message: str, column: int = 1, width: int | None = None) -> None:
        """Report what was not imported, and where it is."""
        source = self.lines[line - 1] if 0 < line <= len(self.lines) else ""
        self.spend(len(source))
        if column == 1:
            column = len(source) - len(source.lstrip()) + 1
        span = Span(self.path, line, column, width or max(1, len(source.rstrip()) - column + 1))
        self.notes.append(Diagnostic("FS802", message, span, severity="warning", source_line=source))


def tidy_node(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the node with its keys in the order of the schema, without empty ones."""
    return {word: raw[word] for word in NODE_WORDS if raw.get(word) not in (None, "", [], {})}


def typed(text: str) -> Any:
    """Return a parameter's value as ROS 2 would read it from a string; the string if readers would differ."""
    stripped = text.strip()
    if stripped.startswith("[") and stripped.endswith("]"):
        return [typed(part.strip(" '\"")) for part in stripped[1:-1].split(",") if part.strip()]
    value = resolve(stripped)
    return text if value is None or isinstance(value, (Refusal, str)) else value


def words(text: str) -> list[str]:
    """Return a command line as a list of arguments; a very long one is split at spaces: shlex takes quadratic time."""
    try:
        return shlex.split(text) if len(text) <= LONGEST_COMMAND else text.split()
    except ValueError:
        return text.split()
